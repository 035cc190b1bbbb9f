"""Going on after a pause: a return stays a return, a landing a landing; a mission that was left is another command."""

from typing import Final

from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.mission.exchange import Exchange
from gcs_plugin.mission.flight_modes import HOLDS, LANDS, RETURNS
from gcs_plugin.mission.flown_items import off_leg_m
from orthoswarm.model.errors import OrthoSwarmError

_ON_WAY_M: Final = 15.0  # one that holds no farther from the way to its item was held on it: vehicles brake in less


def resumed(vehicle: Vehicle) -> Exchange:
    """The dialogue that lets a vehicle go on with what was paused.

    Raises:
        OrthoSwarmError: nothing was paused, or it is not known what.
    """
    name, way, modes, pilot = f"vehicle {vehicle.system}", vehicle.way, vehicle.modes, vehicle.pilot
    if vehicle.unbegun:  # its autopilot would go on at the item at which it left the mission before
        raise OrthoSwarmError(f"{name} has not begun the mission that it was given; start it")
    in_mission = vehicle.custom_mode == modes.mission
    holds = vehicle.flying and vehicle.mode in HOLDS
    if holds and way is not None and way != modes.mission:
        if modes.name(way) in RETURNS:
            return pilot.rtl()
        if modes.name(way) in LANDS:
            return pilot.land()
        raise OrthoSwarmError(f"{name} was flown in {modes.name(way)} before, which nothing here resumes")
    # A pause shows some seconds after it was acknowledged: on a mission there is nothing to pull it out of.
    state = flight_state(vehicle)
    if not (holds or (in_mission and state.word in (Word.PAUSED, Word.ON_MISSION, Word.TAKING_OFF))):
        raise OrthoSwarmError(f"{name} is {state.text}, so there is no pause to end")
    if not in_mission and way is None and not _on_its_way(vehicle):
        text = f"{name} holds, but not on the way to its mission's present item, so it may have been returning"
        raise OrthoSwarmError(f"{text}: send it home (rtl), or give 'continue' to go on with its mission")
    return pilot.go_on(vehicle.custom_mode)


def continued(vehicle: Vehicle) -> Exchange:
    """The dialogue that lets a vehicle go on with its mission, whatever it left it for; the caller has checked that.

    Raises:
        OrthoSwarmError: it does not fly, or has not begun its mission.
    """
    if not vehicle.flying or vehicle.unbegun:
        why = "has not begun the mission that it was given" if vehicle.unbegun else "does not fly"
        raise OrthoSwarmError(f"vehicle {vehicle.system} {why}; start it")
    return vehicle.pilot.go_on(vehicle.custom_mode)


def _on_its_way(vehicle: Vehicle) -> bool:
    """Whether one that was only seen holding stands on the way to its mission's present item."""
    if vehicle.had_failsafe or vehicle.mission is None or vehicle.place is None:
        return False
    away_m = off_leg_m(vehicle.mission, vehicle.mission_seq, vehicle.place)
    return away_m is not None and away_m < _ON_WAY_M
