"""What users run besides the daemon."""
