"""Bytes in, frames out: the links, the session with the board, the board's clock, and an account of every byte."""
