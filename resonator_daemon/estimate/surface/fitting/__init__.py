"""Models of a single contact, fitted to the signals: stick and slip, shape, and one contact instead of a map."""
