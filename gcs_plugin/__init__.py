"""The ground station: command line, links, missions, daemon."""

from typing import TYPE_CHECKING

from orthoswarm.model.lazy_names import on_first_use

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.reception import FleetEvent
    from gcs_plugin.mission.items import Mission, MissionItem
    from gcs_plugin.mission.mission_builder import read_mission
    from gcs_plugin.plans.plan_files import write_plan
    from gcs_plugin.plans.plan_request import PlanRequest, make_plan

__all__ = ["Fleet", "FleetEvent", "Mission", "MissionItem", "PlanRequest", "make_plan", "read_mission", "write_plan"]

__getattr__ = on_first_use(
    __name__,
    {
        "fleet.fleet": ("Fleet",),
        "fleet.reception": ("FleetEvent",),
        "mission.items": ("Mission", "MissionItem"),
        "mission.mission_builder": ("read_mission",),
        "plans.plan_files": ("write_plan",),
        "plans.plan_request": ("PlanRequest", "make_plan"),
    },
)
