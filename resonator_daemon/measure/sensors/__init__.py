"""The kinds of sensor: one captured tone per corner, all tones of force sites, signals under a skin."""
