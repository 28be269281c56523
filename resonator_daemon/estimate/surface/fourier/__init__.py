"""A regular array, frequency by frequency: the multivariate Wiener inverse with a choice of priors."""
