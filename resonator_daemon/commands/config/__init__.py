"""Help with the configuration file."""
