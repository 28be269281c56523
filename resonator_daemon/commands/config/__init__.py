"""Print an example of the configuration file, the meaning of a key, or the schema for editors.

Example: resonatord config explain mqtt.url
"""
