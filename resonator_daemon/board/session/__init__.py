"""The conversation with one board: handshake, frames, gaps, clock synchronisation, loss counters."""
