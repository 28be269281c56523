"""The daemon as it runs: its wiring, its configuration while it lives, what commands and recordings do."""
