"""Emulated plate and board, which replace the hardware for users and tests."""
