"""What a vehicle is said to do, state by state, on both autopilots; docs/vehicles.md holds the same table."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from gcs_plugin.fleet.flight_state import danger_of, flight_state
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.sim.mission_flight import MissionState
from gcs_plugin.sim.simulated_swarm import Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.kit.vehicles.memory_link import World
from tests.vehicles.safety.two_stations import ARM, BY_HAND, HOME, LOITER, OtherStation, short_mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "vehicles.md"
NAMES = {AP: "ArduPilot", PX4: "PX4"}


class Scene:
    """One simulated vehicle, our station, and another one."""

    def __init__(self, autopilot, **mission):
        self.sim = SimVehicle(system=1, autopilot=autopilot)
        self.world = World([self.sim])
        self.other = OtherStation(self.world, shared=True)
        self.flight, self.modes, self.fleet = self.sim.flight, self.sim.flight.modes, self.world.fleet
        self.world.meet()
        self.known = self.fleet.vehicles[1]
        self.mission = short_mission(self.sim, **mission)
        assert self.world.finish(self.fleet.upload(1, self.mission))[0].ok
        self.world.wait(1.5)  # PX4 looks at a new mission first

    def until(self, done, limit_s=120.0):
        assert self.world.until(done, limit_s), flight_state(self.known).text

    def fly(self):
        """On the way to its second waypoint."""
        self.climb()
        self.until(lambda: self.flight.motion.north > 10.0 and self.flight.motion.vn > 5.0)

    def climb(self):
        self.fleet.start(1)
        self.until(lambda: self.flight.motion.up > 2.0)

    def mode(self, mode, settle_s=4.0):
        """Another station changes the mode."""
        self.other.mode(self.sim, mode)
        self.world.wait(settle_s)


# --- what brings a vehicle into each state ---


def stands(scene):
    scene.world.wait(2.0)


def stands_armed(scene):
    scene.mode(scene.modes.ready)
    scene.other.command(scene.sim, ARM, 1.0)
    scene.world.wait(2.0)


def takes_off(scene):
    scene.climb()
    scene.world.wait(1.0)


def flies(scene):
    scene.fly()


def waits_at_a_waypoint(scene):
    scene.climb()
    scene.until(lambda: scene.known.still_s > 6.0 and scene.flight.motion.north > 20.0)


def is_paused(scene):
    scene.fly()
    assert scene.world.finish(scene.fleet.pause(1))[0].ok
    scene.world.wait(6.0)


def is_put_into(mode, settle_s=6.0):
    def drive(scene):
        scene.fly()
        scene.mode(mode(scene), settle_s)

    return drive


def brakes(scene):
    scene.fly()
    scene.mode(scene.modes.hold, 1.2)
    assert scene.known.velocity_m_s[0] > 2.0


def sinks_in(mode):
    def drive(scene):
        scene.climb()
        scene.until(lambda: scene.flight.motion.up > 44.0)
        scene.mode(mode(scene))
        scene.flight.steer(0.0, 0.0, -1.5)
        scene.until(lambda: scene.flight.motion.vu < -1.0)
        scene.world.wait(3.0)

    return drive


def is_moved_in(mode):
    def drive(scene):
        scene.fly()
        scene.mode(mode(scene))
        scene.flight.steer(0.0, 10.0, 0.0)
        scene.world.wait(5.0)

    return drive


def returns(scene):
    scene.fly()
    scene.other.command(scene.sim, HOME)
    scene.until(lambda: scene.flight.motion.vn < -2.0)


def comes_down(scene):
    scene.fly()
    scene.other.command(scene.sim, HOME)
    scene.until(lambda: scene.flight.motion.vu < -1.5)
    scene.world.wait(1.5)


def is_paused_in_return(scene):
    returns(scene)
    scene.mode(scene.modes.hold, 6.0)


def lands(scene):
    scene.fly()
    scene.mode(scene.modes.land)


def is_paused_in_landing(scene):
    scene.fly()
    scene.mode(scene.modes.land, 1.5)
    scene.mode(scene.modes.hold, 4.0)
    assert scene.flight.motion.up > 2.0


def fails(scene):
    scene.fly()
    scene.flight.fail_safe("Battery 1 low voltage failsafe")
    scene.until(lambda: scene.flight.motion.vn < -2.0)


def reports_a_fault(scene):
    scene.fly()
    scene.flight.texts.append("Vibration compensation ON: failsafe near")
    scene.world.wait(1.0)


def has_flown_its_mission(scene):
    scene.climb()
    scene.until(lambda: scene.flight.state is MissionState.COMPLETE)
    scene.world.wait(4.0)


def has_landed_after_it(scene):
    has_flown_its_mission(scene)
    scene.until(lambda: not scene.flight.armed)
    scene.world.wait(2.0)


def lands_in_its_mission(scene):
    scene.climb()
    scene.until(lambda: scene.flight.motion.vu < -1.5)
    scene.world.wait(1.0)


def returns_in_its_mission(scene):
    scene.climb()
    scene.until(lambda: scene.flight.seq == len(scene.mission.items) - 1 and scene.flight.motion.ve < -2.0)
    scene.world.wait(1.0)


def holds_without_a_mission(scene):
    has_flown_its_mission(scene)
    scene.mode(scene.modes.ready, 6.0)


def is_silent(scene):
    scene.fly()
    scene.world.link.down.faults = Faults(loss=1.0)
    scene.world.wait(7.0)


# --- the table ---


def both(copter, px4=""):
    return {AP: copter} | ({PX4: px4} if px4 else {})


@dataclass(frozen=True)
class Row:
    """A state: the modes in which both autopilots, or one of them, have it, and how it shows.

    Attributes:
        modes: by autopilot. motion, mission: in words. says: the state's text; counts as n/m. alarm: of `danger_of`.
        drive: brings a vehicle there. options: of its mission.
    """

    modes: dict[Autopilot, str]
    motion: str
    mission: str
    says: str
    alarm: str
    drive: Callable[[Scene], None]
    options: tuple = ()


def loiter(scene):
    return LOITER[scene.sim.autopilot]


def by_hand(scene):
    return BY_HAND[scene.sim.autopilot]


def guided(scene):
    return scene.modes.ready


def hold(scene):
    return scene.modes.hold


HIGH, HOVERS, LANDS, WAITS = (
    (("height_m", 50.0),), (("ending", "waypoint"),), (("ending", "land"),), (("hold_s", 20.0),),
)  # fmt: skip
ROWS = [
    Row(both("STABILIZE", "HOLD"), "stands", "not begun", "on ground", "", stands),
    Row(both("GUIDED", "HOLD"), "stands", "not begun", "on ground", "", stands_armed),
    Row(both("AUTO", "MISSION"), "climbs", "its takeoff", "taking off", "", takes_off),
    Row(both("AUTO", "MISSION"), "flies", "under way", "on mission n/m", "", flies),
    Row(
        both("AUTO", "MISSION"),
        "waits its time at a waypoint",
        "under way",
        "on mission n/m",
        "",
        waits_at_a_waypoint,
        WAITS,
    ),
    Row(both("AUTO"), "still (`DO_PAUSE_CONTINUE`)", "under way", "paused n/m", "", is_paused),
    Row(both("BRAKE", "HOLD"), "slows down", "left", "paused n/m", "", brakes),
    Row(both("BRAKE", "HOLD"), "still", "left", "paused n/m", "", is_put_into(hold)),
    Row(both("LOITER"), "still", "left", "paused n/m", "", is_put_into(loiter)),
    Row(both("GUIDED"), "still", "left", "paused n/m", "", is_put_into(guided)),
    Row(both("GUIDED", "HOLD"), "is moved", "left", "flying in MODE", "", is_moved_in(guided)),
    Row(both("LOITER", "POSCTL"), "is moved", "left", "flying in MODE", "", is_moved_in(loiter)),
    Row(both("STABILIZE", "STABILIZED"), "still", "left", "flying in MODE", "", is_put_into(by_hand)),
    Row(both("", "POSCTL"), "still", "left", "flying in MODE", "", is_put_into(loiter)),
    Row(both("LOITER", "POSCTL"), "sinks", "left", "descending in MODE", "sinks", sinks_in(loiter), HIGH),
    Row(both("GUIDED", "HOLD"), "sinks", "left", "descending in MODE", "sinks", sinks_in(guided), HIGH),
    Row(both("RTL", "RTL"), "flies", "left", "returning", "", returns),
    Row(both("RTL", "RTL"), "sinks", "left", "landing", "", comes_down),
    Row(both("LAND", "LAND"), "sinks", "left", "landing", "", lands),
    Row(both("BRAKE", "HOLD"), "still", "left for a return", "paused in RTL", "", is_paused_in_return),
    Row(both("BRAKE", "HOLD"), "still", "left for a landing", "paused in LAND", "", is_paused_in_landing),
    Row(both("RTL", "RTL"), "flies, in a failsafe", "left", "returning", "failsafe", fails),
    Row(both("AUTO", "MISSION"), "flies, reports a fault", "under way", "on mission n/m", "its text", reports_a_fault),
    Row(both("AUTO"), "flies home", "its RTL", "returning", "", returns_in_its_mission),
    Row(both("AUTO", "MISSION"), "sinks", "its LAND", "landing", "", lands_in_its_mission, LANDS),
    Row(both("AUTO", "MISSION"), "still", "complete", "holding", "", has_flown_its_mission, HOVERS),
    Row(both("GUIDED", "HOLD"), "still", "complete", "holding", "", holds_without_a_mission, HOVERS),
    Row(both("", "RTL"), "flies", "complete (its RTL)", "returning", "", has_flown_its_mission),
    Row(both("AUTO", "RTL"), "stands, disarmed", "complete", "complete", "", has_landed_after_it),
    Row(both("AUTO", "MISSION"), "is not heard", "under way", "lost", "", is_silent),
]
CASES = [(row, autopilot) for row in ROWS for autopilot in row.modes if row.modes[autopilot]]
_KINDS = {"sinks": "sinks in ", "failsafe": "is in a failsafe", "its text": "says: "}


@pytest.mark.parametrize(
    ("row", "autopilot"), CASES, ids=[f"{a.value}-{r.modes[a]}-{r.motion}-{r.mission}-{r.says}" for r, a in CASES]
)
def test_a_vehicle_is_said_to_do_what_it_does(row, autopilot):
    scene = Scene(autopilot, **dict(row.options))
    try:
        row.drive(scene)
        text, danger = flight_state(scene.known).text, danger_of(scene.known)
        assert scene.known.mode == row.modes[autopilot]
        assert re.sub(r"\d+/\d+", "n/m", text) == row.says.replace("MODE", scene.known.mode)
        assert danger.startswith(_KINDS[row.alarm]) if row.alarm else not danger
        told = [event.text for event in scene.world.events if event.kind == "danger"]
        assert bool(told) == bool(row.alarm), told
    finally:
        scene.fleet.close()


@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_one_that_sinks_to_the_ground_is_descending_all_the_way(autopilot):
    scene = Scene(autopilot, height_m=50.0)
    try:
        sinks_in(loiter)(scene)
        words = set()
        scene.until(lambda: words.add(flight_state(scene.known).word.value) or scene.flight.motion.up < 2.0)
        assert words == {"descending"}
        assert [event.kind for event in scene.world.events].count("danger") == 1
        scene.until(lambda: not scene.flight.armed)
        scene.world.wait(2.0)
        assert flight_state(scene.known).text == "on ground" and not scene.known.danger
    finally:
        scene.fleet.close()


def table():
    """In markdown; rows that differ in their modes only are one."""
    merged = {}
    for row in ROWS:
        modes = merged.setdefault((row.motion, row.mission, row.says, row.alarm), {})
        for autopilot, mode in row.modes.items():
            modes.setdefault(autopilot, []).extend([mode] if mode else [])
    lines = ["| autopilot | mode | motion | mission | state | alarm |", "|---|---|---|---|---|---|"]
    for (motion, mission, says, alarm), modes in merged.items():
        who = [autopilot for autopilot, names in modes.items() if names]
        names = ", ".join(f"`{mode}`" for mode in dict.fromkeys(mode for names in modes.values() for mode in names))
        says = f"`{says}`".replace("n/m", "3/6")
        both_have_it = "both" if len(who) == 2 else NAMES[who[0]]
        lines.append(f"| {both_have_it} | {names} | {motion} | {mission} | {says} | {alarm} |")
    return "\n".join(lines)


def test_the_document_holds_this_table():
    text = DOCUMENT.read_text(encoding="utf-8")
    held = text[text.index("<!-- states -->") + len("<!-- states -->") : text.index("<!-- /states -->")]
    assert held.strip() == table()
