"""Arrays in, arrays out: tones, forces, elasticity, the surface under a skin.

No I/O, clock or configuration, except the log and the cache of decoder set-ups.
"""
