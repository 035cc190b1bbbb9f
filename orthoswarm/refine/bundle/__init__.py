"""Bundle adjustment: normal equations, priors, robust weights, covariance, and the arrays that it works on."""
