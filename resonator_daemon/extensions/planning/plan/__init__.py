"""Plan the frequency codes of a plate, or the sensors under a skin.

Example: resonatord plan codes --grid 4x4 --pitch-mm 5 --force-max-newton 10 --output new-plate.toml
"""
