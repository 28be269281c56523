"""Counts to frequencies, forces, sites and contacts: pure arrays and plain arguments, no I/O and no clock."""
