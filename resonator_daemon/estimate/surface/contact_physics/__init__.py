"""Compact contacts that push, under Coulomb's law of friction, on top of a linear map."""
