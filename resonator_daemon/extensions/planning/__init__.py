"""Planning a plate: which tone each of its force sites gets."""
