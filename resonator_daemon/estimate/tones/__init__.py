"""Records of a counter to tone readings: frequency estimators, windows, merging, unwrapping. Arrays only."""
