"""Session events to messages, without a clock; live and from a recording alike."""
