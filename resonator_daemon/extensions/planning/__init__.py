"""Planning of a plate: the codes of force sites, and the sensors under a skin."""
