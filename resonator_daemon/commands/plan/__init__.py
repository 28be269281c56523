"""Help with the design of a plate."""
