"""Processes that serve what plates publish to other programs, live."""
