"""Pass what plates publish on to Foxglove, Home Assistant or ROS 2, until stopped.

Example: resonatord bridge foxglove --url mqtt://127.0.0.1:1883
"""

ENTRY_POINTS = "bridges"
