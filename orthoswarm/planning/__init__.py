"""From an area to straight-line coverage missions for a swarm (paper III.A): pure geometry in UTM metres.

`Plan` and its parts are the types that other packages use; `orthoswarm.planning.planner` makes them.
"""

from orthoswarm.model.plan import End, Gap, Plan, Sortie, VehiclePlan, Waypoint

__all__ = ["End", "Gap", "Plan", "Sortie", "VehiclePlan", "Waypoint"]
