"""A recording replayed to the messages of its live run."""
