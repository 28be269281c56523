"""Optional features, each in a directory of its own."""
