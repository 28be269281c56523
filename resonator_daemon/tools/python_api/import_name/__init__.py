"""Folder that `make setup` puts on Python's path: what is in it is imported by its own name."""
