"""Camera events from vehicles' links in the journal: once each, with the time of the exposure, over a restart."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from gcs_plugin.daemon.flight_coverage.exposure_journal import EventRequests, ExposureJournal
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.fleet.separation.separation_watch import VehicleNames
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.sim.simulated_swarm import Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.geo import LocalGrid
from tests.kit.vehicles.memory_link import World

GRID = LocalGrid(32632)
PLACE = np.array([600_100.0, 5_300_200.0])


def _feedback(number: int, time_s: float) -> Any:
    lat, lon = GRID.to_geographic(PLACE)
    return dialect.MAVLink_camera_feedback_message(
        int(time_s * 1e6), 1, 0, number, round(lat * 1e7), round(lon * 1e7), 480.0, 80.0, 0.0, 0.0, 0.0, 0.0, 0
    )


def _captured(number: int, result: int = 1, time_s: float = 0.0) -> Any:
    return dialect.MAVLink_camera_image_captured_message(
        1000 * number, int(time_s * 1e6), 1, 0, 0, 0, 0, [1.0, 0.0, 0.0, 0.0], number, result, b""
    )


def test_events_are_kept_once_each_and_survive_a_restart(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.db")
    kept = ExposureJournal(journal, VehicleNames({}, {}))
    first, second = SimpleNamespace(system=1), SimpleNamespace(system=2)
    for number in (1, 2, 2, 3):
        kept.message(first, _feedback(number, 1.78e9 + number), 1.78e9 + number + 0.4)  # type: ignore[arg-type]
        kept.message(first, _captured(number), 1.78e9 + number + 0.5)  # type: ignore[arg-type]
    kept.message(second, _captured(7), 1.78e9 + 0.5)  # type: ignore[arg-type]
    kept.message(second, _captured(8, result=0), 1.78e9 + 1.5)  # type: ignore[arg-type]
    assert kept.write() and not kept.write()
    journal.close()
    journal = Journal(tmp_path / "journal.db")
    events = ExposureJournal(journal, VehicleNames({}, {})).events(GRID)
    journal.close()
    assert [(e.vehicle, e.number, e.time_s) for e in events] == [
        ("v1", 1, 1.78e9 + 1), ("v1", 2, 1.78e9 + 2), ("v1", 3, 1.78e9 + 3), ("v2", 7, 1.78e9 + 0.5),
    ]  # fmt: skip
    assert np.allclose(events[0].position[:2], PLACE, atol=0.1) and events[3].position is None  # type: ignore[index]


class _Camera(SimVehicle):
    """A vehicle whose camera gives its events again when it is asked; `told` holds all of them by number."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.told: dict[int, Any] = {}

    def take(self, count: int) -> None:
        self.waiting = [*range(len(self.told) + 1, len(self.told) + count + 1)]

    def advance(self, now: float) -> list[Any]:
        said = super().advance(now)
        if getattr(self, "waiting", None):
            number = self.waiting.pop(0)
            self.told[number] = _captured(number, time_s=1.78e9 + number)
            said.append(self.told[number])
        return said

    def handle(self, message: Any, sender: Any, now: float) -> list[Any]:
        if message.get_type() == "COMMAND_LONG" and message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            assert message.param1 == dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED
            return [self.told[int(message.param2)]]
        return super().handle(message, sender, now)


def test_events_that_a_bad_link_has_lost_are_asked_for_and_come(tmp_path: Path) -> None:
    vehicle = _Camera(system=1, autopilot=Autopilot.PX4)
    world = World([vehicle], down=Faults(loss=0.3, seed=4), up=Faults(loss=0.2, seed=5))
    journal = Journal(tmp_path / "journal.db")
    kept = ExposureJournal(journal, VehicleNames({}, {}))
    try:
        world.meet()
        world.fleet.subscribe(kept.message, "CAMERA_IMAGE_CAPTURED")
        came: list[int] = []
        world.fleet.subscribe(lambda v, m, t: came.append(m.image_index), "CAMERA_IMAGE_CAPTURED")
        vehicle.take(40)
        world.wait(30.0)
        without = len(set(came))
        EventRequests(world.fleet)
        vehicle.take(40)
        world.wait(60.0)
        kept.write()
    finally:
        world.fleet.close()
    later = {n for n in came if n > 40}
    events = [e for e in kept.events(GRID) if e.number > 40]
    journal.close()
    assert without < 40 and min(later) <= 45 and later >= set(range(min(later), max(later) + 1))
    assert [e.time_s for e in events] == [1.78e9 + e.number for e in events]
