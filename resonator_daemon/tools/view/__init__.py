"""Live view of what plates publish, in a terminal."""
