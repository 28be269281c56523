"""What commands share, those of extensions too: types of arguments, the arguments for a broker, output."""
