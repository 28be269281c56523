"""A recording as files of other formats: the messages that follow from it, for programs without MQTT."""
