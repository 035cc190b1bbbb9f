"""One vehicle's relative block: dense flights are tracked, sparse photos matched, both adjusted without a map."""
