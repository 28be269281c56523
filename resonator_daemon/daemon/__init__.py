"""The daemon as it runs, its monitoring, and decoding on another computer."""
