"""Names of the formats of `resonatord export`."""

from typing import Final

CSV, MCAP, NPZ, PARQUET, ROS2 = "csv", "mcap", "npz", "parquet", "ros2"
FORMATS: Final = (CSV, MCAP, NPZ, PARQUET, ROS2)
