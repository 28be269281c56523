"""The running daemon: wiring, configuration store, commands, recordings."""
