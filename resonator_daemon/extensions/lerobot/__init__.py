"""Datasets for LeRobot from recordings: `resonatord export --format lerobot`."""
