"""From plans and mission files to what each autopilot wants."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.links.mavlink import Autopilot, command_name, dialect
from gcs_plugin.links.packets import Framer
from gcs_plugin.mission import mission_files
from gcs_plugin.mission.items import (
    GIMBAL_CLAIM,
    JUMP,
    LAND,
    LOITER_TIME,
    LOITER_UNLIM,
    MOUNT_CONTROL,
    RTL,
    TAKEOFF,
    TRIGGER_DISTANCE,
    WAYPOINT,
    Ending,
    Mission,
    MissionItem,
)
from gcs_plugin.mission.mission_builder import build_mission, read_mission, unflyable
from gcs_plugin.mission.track import flight_seconds
from gcs_plugin.sim.mission_store import MissionStore
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Plan, Sortie, VehiclePlan, Waypoint
from tests.kit.missions import sortie_mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])


def make_plan(end="rtl", gimbal_pitch_deg=None):
    points = (
        Waypoint(lat_deg=47.398, lon_deg=8.5456, height_m=60.0, camera=True),
        Waypoint(lat_deg=47.400, lon_deg=8.5456, height_m=60.0, camera=False),
        Waypoint(lat_deg=47.400, lon_deg=8.5460, height_m=60.0, camera=True),
        Waypoint(lat_deg=47.398, lon_deg=8.5460, height_m=60.0, camera=False),
        Waypoint(lat_deg=47.3977, lon_deg=8.5456, height_m=65.0),
    )
    sortie = Sortie(
        home_lat_deg=47.3977,
        home_lon_deg=8.5456,
        takeoff_height_m=65.0,
        waypoints=points,
        start_s=0.0,
        time_s=100.0,
        length_m=600.0,
        turns=3,
        photos=40,
    )
    return Plan(
        method="columns",
        vehicles=(VehiclePlan(1, (sortie,)),),
        altitude_m=60.0,
        speed_m_s=8.0,
        trigger_m=12.5,
        spacing_m=30.0,
        footprint_m=(60.0, 45.0),
        end=end,
        epsg=32632,
        area_m2=1e4,
        covered_share=1.0,
        gaps=(),
        separation="",
        warnings=(),
        gimbal_pitch_deg=gimbal_pitch_deg,
    )


def commands(mission):
    return [item.command for item in mission.items]


@BOTH
def test_a_sortie_takes_off_triggers_on_its_legs_and_comes_home(autopilot):
    plan = make_plan()
    mission = sortie_mission(plan, plan.vehicles[0].sorties[0], autopilot)
    flown = mission.items[mission.first_seq :]
    assert [item.command for item in flown] == [
        TAKEOFF, 178, WAYPOINT, TRIGGER_DISTANCE, WAYPOINT, TRIGGER_DISTANCE, WAYPOINT, TRIGGER_DISTANCE, WAYPOINT,
        TRIGGER_DISTANCE, WAYPOINT, RTL,
    ]  # fmt: skip
    triggers = [seq for seq, item in enumerate(mission.items) if item.command == TRIGGER_DISTANCE]
    assert [mission.items[seq].params[0] for seq in triggers] == [12.5, 0.0, 12.5, 0.0]
    for begin, end in zip(triggers[::2], triggers[1::2], strict=True):  # behind a leg's first waypoint and its last
        assert commands(mission)[begin - 1] == WAYPOINT and commands(mission)[begin + 1 : end] == [WAYPOINT]
    assert mission.ending is Ending.RTL
    assert not unflyable(mission.items, autopilot, in_air=False)


def test_item_zero_is_home_on_ardupilot_and_flown_on_px4():
    plan = make_plan()
    sortie = plan.vehicles[0].sorties[0]
    ardupilot, px4 = (sortie_mission(plan, sortie, autopilot) for autopilot in (AP, PX4))
    assert len(ardupilot) == len(px4) + 1
    home = ardupilot.items[0]
    assert (home.command, home.frame, home.lat_deg, home.lon_deg) == (WAYPOINT, 0, 47.3977, 8.5456)
    assert commands(px4)[0] == TAKEOFF and commands(ardupilot)[1] == TAKEOFF
    # NaN is refused by ArduPilot; 0 would turn PX4's nose north
    assert not any(math.isnan(value) for item in ardupilot.items for value in item.params)
    assert all(math.isnan(item.params[3]) for item in px4.items if item.command in (WAYPOINT, TAKEOFF))
    assert unflyable(px4.items, AP, in_air=False) and unflyable(ardupilot.items, PX4, in_air=False)


@pytest.mark.parametrize(("end", "ending"), [("rtl", Ending.RTL), ("land", Ending.LAND), ("hover", Ending.WAYPOINT)])
@BOTH
def test_endings_are_known(autopilot, end, ending):
    plan = make_plan(end)
    assert sortie_mission(plan, plan.vehicles[0].sorties[0], autopilot).ending is ending


def test_the_last_nav_item_decides_the_ending():
    assert (
        Mission(
            PX4, (MissionItem(command=TAKEOFF), MissionItem(command=LAND), MissionItem(command=TRIGGER_DISTANCE))
        ).ending
        is Ending.LAND
    )
    assert Mission(PX4, (MissionItem(command=TAKEOFF), MissionItem(command=LOITER_UNLIM))).ending is Ending.NEVER
    assert Mission(AP, (MissionItem(command=WAYPOINT),)).final_seq is None
    assert (
        Mission(PX4, (MissionItem(command=TAKEOFF), MissionItem(command=WAYPOINT), MissionItem(command=206))).final_seq
        == 1
    )


@pytest.mark.parametrize("suffix", [".plan", ".waypoints"])
@pytest.mark.parametrize("written_for", ["ardupilot", "px4"])
@BOTH
def test_a_file_of_either_kind_becomes_the_same_mission(tmp_path, autopilot, written_for, suffix):
    plan = make_plan(gimbal_pitch_deg=-90.0)
    sortie = plan.vehicles[0].sorties[0]
    items = mission_files.sortie_items(plan, sortie, written_for)
    home = (sortie.home_lat_deg, sortie.home_lon_deg, 0.0)
    if suffix == ".plan":
        text = mission_files.plan_text(items, home, written_for, 8.0)
    else:
        text = mission_files.waypoints_text(items, home)
    path = tmp_path / f"v1{suffix}"
    path.write_text(text)
    read, made = read_mission(path, autopilot), sortie_mission(plan, sortie, autopilot)
    assert repr(read.items) == repr(made.items)  # NaN equals NaN here


@BOTH
def test_a_jump_leads_to_the_same_place_where_a_gimbal_takes_more_or_fewer_items(autopilot):
    fly = mission_files.FileItem(command=WAYPOINT, frame=3, lat_deg=47.4, lon_deg=8.5, alt_m=60.0)
    target = mission_files.FileItem(command=WAYPOINT, frame=3, lat_deg=47.5, lon_deg=8.5, alt_m=60.0)
    for written_for in ("ardupilot", "px4"):
        aim = mission_files.gimbal_items(-90.0, written_for)
        jump = mission_files.FileItem(command=JUMP, params=(2.0 + len(aim), 1.0, 0.0, 0.0))
        items = build_mission(autopilot, [fly, *aim, target, jump]).items
        assert items[int(items[-1].params[0])].lat_deg == pytest.approx(47.5)


def test_what_else_a_mission_does_with_a_gimbal_stays():
    aside = mission_files.FileItem(command=MOUNT_CONTROL, params=(-45.0, 0.0, 30.0, 0.0), alt_m=2.0)
    free = mission_files.FileItem(command=GIMBAL_CLAIM, params=(-3.0, -3.0, -1.0, -1.0))
    fly = mission_files.FileItem(command=WAYPOINT, frame=3, lat_deg=47.4, lon_deg=8.5, alt_m=60.0)
    assert [item.command for item in build_mission(PX4, [fly, aside, free]).items] == [16, MOUNT_CONTROL, GIMBAL_CLAIM]
    # ArduPilot refuses a mission that asks for control
    assert [item.command for item in build_mission(AP, [fly, aside, free]).items] == [16, 16, MOUNT_CONTROL]


@pytest.mark.parametrize("command", [WAYPOINT, TAKEOFF, LAND, LOITER_TIME])
def test_a_yaw_of_0_is_none_for_px4(command):
    item = mission_files.FileItem(command=command, frame=3, lat_deg=47.4, lon_deg=8.5, alt_m=60.0)
    assert math.isnan(build_mission(PX4, [item]).items[0].params[3])
    assert build_mission(AP, [item]).items[1].params[3] == 0.0


@BOTH
def test_a_vehicle_stores_what_is_built(autopilot):
    plan = make_plan(gimbal_pitch_deg=-90.0)
    mission = sortie_mission(plan, plan.vehicles[0].sorties[0], autopilot)
    store = MissionStore(autopilot=autopilot, home=MissionItem(command=WAYPOINT))
    assert all(store._check(item, len(mission)) == 0 for item in mission.items)


def test_what_cannot_be_flown_is_refused_before_anything_is_sent(tmp_path):
    item = mission_files.FileItem
    with pytest.raises(InputError, match="no items"):
        build_mission(PX4, [], name="empty.plan")
    with pytest.raises(InputError, match="not a place"):
        build_mission(PX4, [item(command=WAYPOINT, frame=3, lat_deg=95.0, lon_deg=8.0, alt_m=20.0)])
    with pytest.raises(InputError, match="height"):
        build_mission(AP, [item(command=WAYPOINT, frame=3, lat_deg=45.0, lon_deg=8.0, alt_m=2e6)])
    with pytest.raises(InputError, match="650"):
        build_mission(AP, [item(command=WAYPOINT, frame=3, lat_deg=45.0, lon_deg=8.0, alt_m=20.0)] * 700)
    assert (
        len(build_mission(PX4, [item(command=WAYPOINT, frame=3, lat_deg=45.0, lon_deg=8.0, alt_m=20.0)] * 700)) == 700
    )
    with pytest.raises(InputError, match="cannot be read"):
        read_mission(tmp_path / "absent.plan", AP)
    junk = tmp_path / "junk.plan"
    junk.write_bytes(bytes(range(256)))
    with pytest.raises(InputError):
        read_mission(junk, AP)


finite = st.floats(-1e4, 1e4, width=32)


@given(
    st.sampled_from([16, 17, 20, 21, 22, 178, 206, 177, 93]),
    st.sampled_from([0, 2, 3, 6, 10]),
    st.tuples(finite, finite, finite, st.one_of(finite, st.just(math.nan))),
    st.integers(-900_000_000, 900_000_000),
    st.integers(-1_800_000_000, 1_800_000_000),
    st.floats(-1000, 9000, width=32),
)
@settings(max_examples=150, deadline=None)
def test_an_item_survives_the_wire(command, frame, params, x, y, z):
    item = MissionItem(command=command, frame=frame, params=params, x=x, y=y, z=z)
    raw = item.message(5, 1, 1).pack(dialect.MAVLink(None, 255, 190))
    (packet,) = Framer().feed(raw)
    assert packet.message.seq == 5
    assert repr(MissionItem.of(packet.message)) == repr(item)


def test_an_old_item_with_degrees_in_floats_is_understood():
    old = dialect.MAVLink_mission_item_message(1, 1, 2, 3, 16, 0, 1, 0, 0, 0, 0, 47.5, 8.25, 30.0, 0)
    item = MissionItem.of(old)
    assert (item.lat_deg, item.lon_deg, item.z) == (47.5, 8.25, 30.0)


def test_commands_have_names():
    assert command_name(206) == "DO_SET_CAM_TRIGG_DIST" and command_name(31999) == "command 31999"


@pytest.mark.parametrize("written", ["1e400", "-1e400", "50000"])
def test_an_altitude_where_nothing_flies_is_one_clear_sentence(written, tmp_path):
    text = """{"fileType": "Plan", "mission": {"items": [{"type": "SimpleItem", "command": 16, "frame": 3,
        "params": [0, 0, 0, null, 47.0, 8.0, %s]}]}}"""
    (tmp_path / "high.plan").write_text(text % written)
    for autopilot in (AP, PX4):
        with pytest.raises(InputError, match=r"an item has the altitude \S+ m, where nothing flies"):
            read_mission(tmp_path / "high.plan", autopilot)


def jumping(target, times=2.0, hold_s=0.0):
    """Takeoff (1), two waypoints (2, 3), a jump, return."""
    at = [47.397, 47.3979, 47.3988]
    flown = [
        mission_files.FileItem(
            command=command, frame=3, params=(hold, 0.0, 0.0, 0.0), lat_deg=lat, lon_deg=8.545, alt_m=20.0
        )
        for command, lat, hold in ((22, at[0], 0.0), (16, at[1], hold_s), (16, at[2], 0.0))
    ]
    return [
        *flown,
        mission_files.FileItem(command=JUMP, params=(target, times, 0.0, 0.0)),
        mission_files.FileItem(command=RTL),
    ]


@BOTH
def test_a_jump_leads_to_the_same_item_on_either_autopilot(autopilot):
    mission = build_mission(autopilot, jumping(2.0))
    (jump,) = [item for item in mission.items if item.command == JUMP]
    assert mission.items[int(jump.params[0])].lat_deg == pytest.approx(47.3979)
    for target in (0.0, 6.0, math.nan):
        with pytest.raises(InputError, match="jumps to item"):
            build_mission(autopilot, jumping(target))


@BOTH
def test_what_is_flown_again_and_waited_for_takes_its_time(autopilot):
    def seconds(**options):
        return flight_seconds(build_mission(autopilot, jumping(2.0, **options)))

    once = seconds(times=0.0)
    assert seconds(times=2.0) > seconds(times=1.0) + 30.0 > once + 60.0
    assert seconds(times=-1.0) > 20.0 * once  # for ever
    assert seconds(times=0.0, hold_s=25.0) == pytest.approx(once + 25.0, abs=3.0)
    assert seconds(times=1.0, hold_s=25.0) == pytest.approx(seconds(times=1.0) + 50.0, abs=6.0)


def test_many_repeats_are_followed_to_the_end():
    many = build_mission(Autopilot.ARDUPILOT, jumping(2.0, times=300.0))
    few = build_mission(Autopilot.ARDUPILOT, jumping(2.0, times=100.0))
    none = flight_seconds(build_mission(Autopilot.ARDUPILOT, jumping(2.0, times=0.0)))
    assert flight_seconds(many) - none == pytest.approx(3.0 * (flight_seconds(few) - none), rel=0.01)
