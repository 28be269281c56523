"""The wire between board and host: bytes to messages and back, and both ends' session rules. No I/O, no clock."""
