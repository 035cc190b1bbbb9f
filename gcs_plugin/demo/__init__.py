"""`orthoswarm demo`: a simulated swarm with simulated cameras over a simulated city, mapped by the real daemon."""
