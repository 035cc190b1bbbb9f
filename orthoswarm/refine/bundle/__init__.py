"""Bundle adjustment: normal equations, priors, robust weights, covariance and its arrays."""
