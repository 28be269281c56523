"""Test vectors: what every implementation of the wire must make of given bytes; README.md explains their use."""
