"""Show what plates publish in other programs, until stopped."""
