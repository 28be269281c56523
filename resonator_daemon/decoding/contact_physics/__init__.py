"""Compact contacts that push and obey Coulomb's law, on top of a linear map."""
