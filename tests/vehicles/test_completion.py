"""The completion detector against what ArduCopter 4.7 and PX4 were measured to send, and against recorded flights."""

import itertools
import json
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.completion import CompletionDetector, MissionEvent, Phase
from gcs_plugin.mission.items import LAND, LOITER_UNLIM, RTL, TAKEOFF, TRIGGER_DISTANCE, WAYPOINT, Mission, MissionItem
from tests.kit.vehicles.telemetry_log import read_tlog

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 2, 3, 4, 5
AUTO = {AP: 3, PX4: (4 << 16) | (4 << 24)}
OTHER_MODE = {AP: 6, PX4: (4 << 16) | (5 << 24)}


def heartbeat(armed, autopilot=AP, auto=True):
    kind = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA if autopilot is AP else dialect.MAV_AUTOPILOT_PX4
    mode = (AUTO if auto else OTHER_MODE)[autopilot]
    return dialect.MAVLink_heartbeat_message(2, kind, 81 | (128 if armed else 0), mode, 4, 3)


def current(seq, state, total=0):
    return dialect.MAVLink_mission_current_message(seq, total, state, 1)


def reached(seq):
    return dialect.MAVLink_mission_item_reached_message(seq)


def landed(state):
    return dialect.MAVLink_extended_sys_state_message(0, state)


def mission(autopilot, *commands):
    home = [MissionItem.at(WAYPOINT, 47.0, 8.0, 0.0)] if autopilot is AP else []
    return Mission(autopilot, (*home, *(MissionItem(command=c) for c in commands)))


# Missions of the table: what is flown, by the last item.
BODIES = {
    "rtl": (TAKEOFF, WAYPOINT, WAYPOINT, RTL),
    "land": (TAKEOFF, WAYPOINT, WAYPOINT, LAND),
    "waypoint": (TAKEOFF, WAYPOINT, WAYPOINT, WAYPOINT),
    "do": (TAKEOFF, WAYPOINT, WAYPOINT, TRIGGER_DISTANCE),
    "loiter": (TAKEOFF, WAYPOINT, WAYPOINT, LOITER_UNLIM),
}


def flight(autopilot, ending, state=True):
    """The messages of one whole flight as the table of measured behaviour gives them (first item 1, or 0 on PX4)."""
    first = 1 if autopilot is AP else 0
    last = first + 3
    say = (lambda seq, value: current(seq, value)) if state else (lambda seq, value: current(seq, 0))
    up = lambda auto=True: heartbeat(True, autopilot, auto)  # noqa: E731
    down = lambda auto=True: heartbeat(False, autopilot, auto)  # noqa: E731
    yield from (down(False), say(0, NOT_STARTED), landed(1), up(False), say(0, NOT_STARTED), up(), landed(3))
    for seq in range(first, last):
        yield from (say(seq, ACTIVE), up(), say(seq, ACTIVE), landed(2), reached(seq))
    if ending == "do":
        yield from (say(last, COMPLETE), up(), say(last, COMPLETE), up())
        return
    if ending == "abort":  # the operator's RTL in mid mission
        yield from (say(last - 1, ACTIVE), up(False), say(last - 1, NOT_STARTED), up(False), landed(4))
        yield from (landed(1), down(False), say(0, NOT_STARTED), down(False), say(0, NOT_STARTED))
        return
    yield from (say(last, ACTIVE), up(), say(last, ACTIVE), up(), say(last, ACTIVE))
    if ending == "loiter":
        yield from (up(), say(last, ACTIVE)) * 20
    elif ending == "waypoint":
        yield from (reached(last), say(last, COMPLETE), up(), say(last, COMPLETE), up())
    elif autopilot is PX4 and ending == "rtl":
        yield from (say(last, COMPLETE), up(False), say(last, COMPLETE), landed(4), say(last, COMPLETE))
        yield from (landed(1), down(False), say(0, NOT_STARTED), down(False))
    elif autopilot is PX4:
        yield from (landed(4), up(), landed(1), say(last, COMPLETE), down(), say(last, COMPLETE))
        yield from (down(), say(0, ACTIVE), say(0, ACTIVE), down())
    elif ending == "rtl":
        yield from (landed(4), up(), landed(1), reached(last), down(), say(0, COMPLETE), down(), say(0, COMPLETE))
    else:
        yield from (landed(4), up(), say(last, ACTIVE), down(), landed(1), say(1, ACTIVE), down(), say(1, ACTIVE))
        yield from (down(), say(1, ACTIVE)) * 3


def run(detector, messages):
    return [event for message in messages for event in detector.feed(message)]


def fly(autopilot, ending, known=True, state=True):
    detector = CompletionDetector(autopilot=autopilot)
    commands = BODIES["rtl" if ending == "abort" else ending]
    detector.uploaded(mission(autopilot, *commands) if known else None)
    return detector, run(detector, flight(autopilot, ending, state))


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_each_flown_mission_completes_exactly_once(autopilot, ending):
    detector, events = fly(autopilot, ending)
    assert events == [MissionEvent.STARTED, MissionEvent.COMPLETE]
    assert detector.phase is Phase.COMPLETE


@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_loiter_unlimited_never_completes(autopilot):
    detector, events = fly(autopilot, "loiter")
    assert events == [MissionEvent.STARTED]
    # the operator brings it home: ended, not complete
    home = [heartbeat(True, autopilot, False), current(4, NOT_STARTED), heartbeat(False, autopilot, False)]
    assert run(detector, home) == [MissionEvent.SUSPENDED, MissionEvent.ABORTED]


@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_an_operators_rtl_ends_the_mission_without_completing_it(autopilot):
    detector, events = fly(autopilot, "abort")
    assert events == [MissionEvent.STARTED, MissionEvent.SUSPENDED, MissionEvent.ABORTED]
    assert detector.phase is Phase.ABORTED


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_a_stale_complete_after_clear_and_upload_is_not_a_flight(autopilot, ending):
    detector, _ = fly(autopilot, ending)
    detector.uploaded(mission(autopilot, *BODIES[ending]))
    stale = [current(0, COMPLETE), heartbeat(False, autopilot), current(0, COMPLETE), heartbeat(True, autopilot)]
    assert run(detector, stale * 3) == []
    # only the next flight counts, and it counts once
    assert run(detector, flight(autopilot, ending)) == [MissionEvent.STARTED, MissionEvent.COMPLETE]


def test_joining_a_vehicle_that_has_completed_says_nothing():
    detector = CompletionDetector(autopilot=AP)
    assert run(detector, [heartbeat(True), current(4, COMPLETE, 4), heartbeat(True), current(4, COMPLETE, 4)]) == []


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_a_second_flight_of_the_same_mission_completes_again(autopilot, ending):
    detector, _ = fly(autopilot, ending)
    down = [heartbeat(False, autopilot)]
    events = run(detector, [*down, *flight(autopilot, ending)])
    assert events == [MissionEvent.STARTED, MissionEvent.COMPLETE]


def test_a_restart_in_the_air_is_a_new_flight_but_one_late_packet_is_not():
    detector, _ = fly(AP, "waypoint")
    assert run(detector, [current(3, ACTIVE), current(4, COMPLETE), heartbeat(True)]) == []
    again = [current(1, ACTIVE), current(1, ACTIVE), current(4, ACTIVE), reached(4), current(4, COMPLETE)]
    assert run(detector, again) == [MissionEvent.STARTED, MissionEvent.COMPLETE]


def test_an_upload_in_the_air_is_not_started_by_a_late_packet_of_the_old_mission():
    detector, _ = fly(AP, "waypoint")
    detector.uploaded(mission(AP, *BODIES["rtl"]))
    assert run(detector, [current(4, ACTIVE), current(4, COMPLETE), current(0, COMPLETE)]) == []


def test_pause_and_resume_are_one_flight():
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES["rtl"]))
    start = [heartbeat(True), current(2, ACTIVE), heartbeat(True, auto=False), current(2, NOT_STARTED)]
    end = [heartbeat(True), current(2, ACTIVE), current(4, ACTIVE), heartbeat(False), current(0, COMPLETE)]
    assert run(detector, start + end) == [
        MissionEvent.STARTED, MissionEvent.SUSPENDED, MissionEvent.RESUMED, MissionEvent.COMPLETE,
    ]  # fmt: skip


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_end_of_a_landing_may_arrive_in_any_order(order):
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES["land"]))
    run(detector, [heartbeat(True), current(3, ACTIVE), current(4, ACTIVE), current(4, ACTIVE)])
    last_words = [heartbeat(False), current(1, ACTIVE), landed(1)]
    events = run(detector, [last_words[i] for i in order] + [heartbeat(False), current(1, ACTIVE)] * 4)
    assert events == [MissionEvent.COMPLETE]


def test_a_lost_disarming_after_a_landing_starts_nothing():
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES["land"]))
    run(detector, [heartbeat(True), landed(2), current(3, ACTIVE), current(4, ACTIVE), landed(4)])
    assert run(detector, [landed(1), *[current(1, ACTIVE)] * 5, heartbeat(False)]) == [MissionEvent.COMPLETE]


@pytest.mark.parametrize("ending", ["rtl", "land"])
def test_a_late_heartbeat_of_the_flight_starts_nothing(ending):
    detector, _ = fly(AP, ending)
    late = [heartbeat(True), current(4, ACTIVE), current(4, ACTIVE), heartbeat(False)]
    assert run(detector, [*late, current(0 if ending == "rtl" else 1, COMPLETE if ending == "rtl" else ACTIVE)]) == []


def test_a_mission_set_back_during_the_landing_has_not_completed():
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES["land"]))
    run(detector, [heartbeat(True), current(4, ACTIVE), current(1, ACTIVE), heartbeat(True), heartbeat(True)])
    assert run(detector, [heartbeat(False), *[current(1, ACTIVE)] * 4]) == [MissionEvent.ABORTED]


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "loiter"])
def test_a_crash_on_the_way_is_no_completion(ending):
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES[ending]))
    run(detector, [heartbeat(True), current(2, ACTIVE), current(3, ACTIVE)])
    crash = dialect.MAVLink_statustext_message(0, b"Crash: Disarming: AngErr=99>30")
    assert run(detector, [crash, heartbeat(False), current(1, ACTIVE)]) == [MissionEvent.ABORTED]


@pytest.mark.parametrize("ending", ["rtl", "waypoint", "loiter"])
def test_disarming_at_the_last_item_completes_only_a_landing(ending):
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES[ending]))
    run(detector, [heartbeat(True), current(4, ACTIVE)])
    assert run(detector, [heartbeat(False), *[current(1, ACTIVE)] * 4]) == [MissionEvent.ABORTED]


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_a_mission_that_somebody_else_uploaded_completes_too(autopilot, ending):
    detector = CompletionDetector(autopilot=autopilot)
    total = 4
    messages = [
        current(m.seq, m.mission_state, total) if m.get_type() == "MISSION_CURRENT" else m
        for m in flight(autopilot, ending)
    ]
    assert run(detector, messages) == [MissionEvent.STARTED, MissionEvent.COMPLETE]


def test_a_mission_replaced_by_another_ground_station_is_forgotten():
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES["rtl"]))
    run(detector, [heartbeat(True), current(2, ACTIVE, 4)])
    request = dialect.MAVLink_mission_request_message(254, 190, 0, 0)
    assert run(detector, [request, current(0, COMPLETE, 7), current(0, COMPLETE, 7)]) == [MissionEvent.ABORTED]
    detector.uploaded(mission(AP, *BODIES["rtl"]))
    run(detector, [heartbeat(True), current(2, ACTIVE, 4), current(2, ACTIVE, 4)])
    other = [current(0, 2, 7), current(0, 2, 7), current(0, COMPLETE, 7)]
    assert run(detector, other) == [MissionEvent.SUSPENDED, MissionEvent.ABORTED]
    assert detector.phase is Phase.IDLE


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do"])
def test_firmware_without_mission_state_is_judged_by_what_it_reaches(ending):
    _, events = fly(AP, ending, state=False)
    assert events == [MissionEvent.STARTED, MissionEvent.COMPLETE]


def test_a_reboot_in_flight_aborts():
    detector = CompletionDetector(autopilot=PX4)
    detector.uploaded(mission(PX4, *BODIES["rtl"]))
    run(detector, [heartbeat(True, PX4), current(1, ACTIVE)])
    assert detector.rebooted() == [MissionEvent.ABORTED]
    assert run(detector, [heartbeat(False, PX4), current(0, COMPLETE)] * 3) == []


def test_heartbeats_of_other_components_do_not_disarm():
    detector = CompletionDetector(autopilot=AP)
    detector.uploaded(mission(AP, *BODIES["land"]))
    run(detector, [heartbeat(True), current(4, ACTIVE)])
    camera = dialect.MAVLink_heartbeat_message(30, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    assert run(detector, [camera, current(4, ACTIVE)]) == []
    assert run(detector, [heartbeat(False)]) == [MissionEvent.COMPLETE]


def lossy(messages, random, loss, copies):
    """What is left of the messages: telemetry repeats itself on a real flight, and each copy is lost on its own."""
    for message in messages:
        times = 1 if message.get_type() == "MISSION_ITEM_REACHED" else copies
        yield from [message] * sum(random.random() >= loss for _ in range(times))


@given(
    st.sampled_from(["rtl", "land", "waypoint", "do", "loiter", "abort"]),
    st.sampled_from([AP, PX4]),
    st.randoms(use_true_random=False),
    st.floats(0.0, 0.9),
)
@settings(max_examples=150, deadline=None)
def test_no_pattern_of_loss_gives_a_false_or_second_completion(ending, autopilot, random, loss):
    detector = CompletionDetector(autopilot=autopilot)
    detector.uploaded(mission(autopilot, *BODIES["rtl" if ending == "abort" else ending]))
    events = run(detector, lossy(flight(autopilot, ending), random, loss, copies=2))
    assert events.count(MissionEvent.COMPLETE) <= (0 if ending in ("loiter", "abort") else 1)


@pytest.mark.parametrize("ending", ["rtl", "land", "waypoint", "do", "loiter", "abort"])
@pytest.mark.parametrize("autopilot", [AP, PX4])
def test_a_loss_of_thirty_percent_hides_no_completion(autopilot, ending):
    for seed in range(30):
        detector = CompletionDetector(autopilot=autopilot)
        detector.uploaded(mission(autopilot, *BODIES["rtl" if ending == "abort" else ending]))
        events = run(detector, lossy(flight(autopilot, ending), Random(seed), 0.3, copies=10))
        assert events.count(MissionEvent.COMPLETE) == (0 if ending in ("loiter", "abort") else 1)


@given(st.integers(0, 60), st.sampled_from(["rtl", "land", "waypoint", "do", "abort"]), st.sampled_from([AP, PX4]))
@settings(max_examples=100, deadline=None)
def test_a_restarted_program_goes_on_where_it_stopped(cut, ending, autopilot):
    body = mission(autopilot, *BODIES["rtl" if ending == "abort" else ending])
    messages = list(flight(autopilot, ending))
    first = CompletionDetector(autopilot=autopilot)
    first.uploaded(body)
    events = run(first, messages[:cut])
    second = CompletionDetector.from_state(json.loads(json.dumps(first.state())))
    events += run(second, messages[cut:])
    assert events.count(MissionEvent.COMPLETE) == (0 if ending == "abort" else 1)


@pytest.mark.parametrize("lead", [0, 1, 2])
def test_a_mission_of_another_station_that_starts_at_once_starts_once(lead):
    """The number of items changes, and the mission is active, before a second message has confirmed the number."""
    detector = CompletionDetector(autopilot=AP)
    before = [heartbeat(False), current(0, NOT_STARTED, 12), current(0, NOT_STARTED, 12)]
    started = [*[current(0, NOT_STARTED, 11)] * lead, heartbeat(True), *[current(1, ACTIVE, 11)] * 4]
    assert run(detector, [*before, *started]) == [MissionEvent.STARTED]
    assert detector.total == 11
    other = [current(1, ACTIVE, 7)] * 4  # a mission that another station stores in flight is another one
    assert run(detector, other) == [MissionEvent.ABORTED, MissionEvent.STARTED] and detector.total == 7


@pytest.mark.parametrize("log", ["copter_cam_rtl_1x", "swarm_v1", "swarm_v2", "swarm_v3"])
def test_recorded_flights_complete_exactly_once(real_data, log):
    detector = CompletionDetector(autopilot=AP)
    events, end = [], None
    packets = list(read_tlog(real_data("sitl_logs") / f"{log}.tlog"))
    for time_s, packet in packets:
        for event in detector.feed(packet.message):
            events.append(event)
            end = time_s
    assert events == [MissionEvent.STARTED, MissionEvent.COMPLETE]
    assert packets[-1][0] - end < 10.0  # at the landing, which is the end of the log
    assert detector.ending.value == "rtl"
