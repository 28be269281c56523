"""What every implementation of the wire must make of given bytes; README.md says how to use it."""
