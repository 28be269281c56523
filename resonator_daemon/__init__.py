"""Acquisition daemon and decoder for a quartz-resonator tactile plate."""
