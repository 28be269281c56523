"""A recording as what was measured and published: the same on every run."""
