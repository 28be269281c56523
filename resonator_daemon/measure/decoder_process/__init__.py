"""Decoding of a skin in a process of its own, which the daemon starts, supervises and restarts."""
