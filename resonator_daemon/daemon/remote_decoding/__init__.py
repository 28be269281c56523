"""Decoding apart from the daemon: from `signals` and `info` on the broker to the surface, in a process of its own."""
