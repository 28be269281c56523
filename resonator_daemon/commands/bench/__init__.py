"""Measure this machine with an emulated plate."""
