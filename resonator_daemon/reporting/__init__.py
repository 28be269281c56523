"""From what arrives of a board to what is published of it: without a clock, live and from a recording alike."""
