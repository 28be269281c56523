"""Sites anywhere under an infinite plane: the covariances of a stationary prior, and the Bayes estimate."""
