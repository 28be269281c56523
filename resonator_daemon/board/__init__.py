"""A counter board: links, the session on them, recordings, configuration."""
