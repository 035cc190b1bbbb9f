"""Verbs that plan flights, speak with vehicles, and run the daemon and simulations."""
