"""Whole missions on simulated vehicles and, with `-m sitl`, on real autopilots."""
