"""Missions of a plan's sorties, made of the same pieces as those that `plan` writes and the daemon reads."""

from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission import mission_files
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.mission_builder import build_mission
from orthoswarm.model.plan import Plan, Sortie


def sortie_mission(plan: Plan, sortie: Sortie, autopilot: Autopilot) -> Mission:
    """The mission of one sortie: takeoff, legs with the camera's trigger on and off, the way home."""
    written_for: mission_files.Autopilot = "ardupilot" if autopilot is Autopilot.ARDUPILOT else "px4"
    items = mission_files.sortie_items(plan, sortie, written_for)
    return build_mission(autopilot, items, (sortie.home_lat_deg, sortie.home_lon_deg, 0.0))
