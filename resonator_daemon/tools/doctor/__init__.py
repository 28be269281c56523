"""Is it the wiring, the sensor, the software, or is all fine: one check for each idea, and the report."""
