"""Tone readings to forces, sites and contacts, with drift and response. Arrays only."""
