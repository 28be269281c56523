"""Topics, payloads and the MQTT clients: what leaves the daemon and how it is read again."""
