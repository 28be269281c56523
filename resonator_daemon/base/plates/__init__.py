"""The plate files that ship with the daemon."""
