"""Emulated plate and board: what the daemon sees when no hardware is at hand."""
