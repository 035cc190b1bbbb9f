"""Alarms: what gets worse is said again, Seen is for what is on the screen, and a second page raises the same."""

import time

import pytest

from tests.kit.page_kit import opened, send, standing, vehicle

SOUNDS = """() => {
  window.beeps = 0;
  AudioContext.prototype.createOscillator = () => { window.beeps++; throw new Error("silent"); };
}"""


def texts(page) -> list[str]:
    return page.locator(".alarms:visible li").all_inner_texts()


def seen(page):
    page.wait_for_timeout(400)  # what came up just before the press was not read
    page.click(".alarms >> text=Seen")


def change(page, **what):
    send(page, {"type": "vehicle", "id": "v1", "system": 1} | what)


def test_an_alarm_that_was_seen_and_gets_worse_is_an_alarm_again(browser):
    with standing(vehicle(1, battery=0.22)) as station, opened(browser, station.url) as page:
        page.evaluate(SOUNDS)
        page.wait_for_selector(".alarms:has-text('CAUTION v1: battery low')")
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        page.wait_for_timeout(800)
        before = page.evaluate("beeps")
        change(page, battery=0.08)
        page.wait_for_selector(".alarms:has-text('DANGER v1: battery 8 %: land now')")
        page.wait_for_function("(before) => beeps > before", arg=before)
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        change(page, battery=0.07)  # no new level: it was seen
        page.wait_for_selector(".tile .why:has-text('7 %')")
        page.wait_for_timeout(300)
        assert texts(page) == []


def test_seen_is_for_the_alarms_that_are_listed(browser):
    """One cause is one line, whoever it concerns; what does not fit on the screen is not seen."""
    rows = [vehicle(k, battery=0.1, alarm=f"v{k} is in a failsafe {k}") for k in range(1, 8)]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('and 3 more')")
        first = texts(page)
        assert len(first) == 5
        assert "DANGER Battery: v1, v2, v3, v4, v5, v6, v7" in first
        seen(page)
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length === 3")
        assert not set(first) & set(texts(page))
        assert "more" not in page.inner_text(".alarms")
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        page.click("summary:has-text('Alarms so far: 14')")
        page.wait_for_selector(".past li:has-text('DANGER v7: battery 10 %')")


NEAR = "v1 and v2 are 4.0 m apart and 1.0 m in height: pause v2"


def test_a_page_that_is_opened_while_two_are_too_near_raises_the_alarm(browser):
    rows = [vehicle(1, alarm=NEAR), vehicle(2, alarm=NEAR), vehicle(3, alarm="")]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('4.0 m apart')")
        assert len(texts(page)) == 1  # one pair
        for k in (1, 2):
            send(page, {"type": "vehicle", "id": f"v{k}", "system": k, "alarm": NEAR.replace("4.0", "3.0")})
        page.wait_for_selector(".alarms:has-text('3.0 m apart')")
        seen(page)
        for k in (1, 2):
            send(page, {"type": "vehicle", "id": f"v{k}", "system": k, "alarm": NEAR.replace("4.0", "2.0")})
        page.wait_for_timeout(500)
        assert texts(page) == []  # the same pair
        for k in (1, 2):
            send(page, {"type": "vehicle", "id": f"v{k}", "system": k, "alarm": ""})
        page.wait_for_timeout(300)
        for k in (1, 3):
            send(page, {"type": "vehicle", "id": f"v{k}", "system": k, "alarm": "v1 and v3 are 2.0 m apart"})
        page.wait_for_selector(".alarms:has-text('v1 and v3')")


def test_a_vehicle_behind_its_plan_is_an_alarm_on_every_page_until_it_has_caught_up(browser):
    late = "is 12 s late; its plan keeps others apart up to 8 s: watch its distances, consider pausing it"
    with standing(vehicle(1, behind=late), vehicle(2)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('CAUTION v1: is 12 s late')")
        assert len(texts(page)) == 1
        assert ", 0 in danger, 1 to watch" in page.inner_text("#panel-fly .strip > p")
        send(page, {"type": "vehicle", "id": "v1", "system": 1, "behind": ""})
        page.wait_for_selector(".alarms", state="hidden")


def test_what_the_operator_paused_is_late_and_no_alarm(browser):
    late = "is 59 s late after its pause; its plan keeps others apart up to 10 s: watch its distances"
    rows = vehicle(1, behind=late, behind_ordered=True), vehicle(2)
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile .why:has-text('59 s late after its pause')")
        page.wait_for_timeout(500)
        assert texts(page) == []


def test_without_the_station_nobody_knows_of_the_vehicles_links(browser):
    """GIVEN eight vehicles WHEN the station is lost THEN that is the alarm, once; and in danger is who has one."""
    with standing(*[vehicle(k) for k in range(1, 9)]) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=7")
        page.evaluate("window.station.beats = false")
        page.wait_for_selector(".banner:visible")
        page.wait_for_timeout(6000)  # longer than a vehicle may be silent
        assert texts(page) == ["DANGER Nothing received from the ground station"]
        assert "8 in the air, 0 in danger" in page.inner_text("#panel-fly .strip > p")
        page.evaluate("window.station.beats = true")
        page.wait_for_selector(".banner", state="hidden")
        send(page, event("text", "Crash: Disarming", severity=0))
        page.wait_for_selector(".strip > p:has-text('1 in danger')")


@pytest.mark.slow
def test_an_alarm_of_a_pair_ends_with_the_rows_if_the_page_missed_the_event(browser):
    event = {"type": "vehicle_event", "kind": "near", "vehicle": "v1", "pair": ["v1", "v2"], "text": NEAR}
    with standing(vehicle(1, alarm=""), vehicle(2, alarm="")) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=1")
        send(page, event)
        page.wait_for_selector(".alarms:has-text('4.0 m apart')")
        for _ in range(2):
            for k in (1, 2):
                send(page, {"type": "vehicle", "id": f"v{k}", "system": k, "alarm": ""})
            page.wait_for_timeout(500)
        page.wait_for_selector(".alarms", state="hidden")


def event(kind, text="", severity=6, when=1_780_000_001.0):
    said = {"said": text, "severity": severity} if kind == "text" else {}
    return {"type": "vehicle_event", "vehicle": "v1", "kind": kind, "text": f"vehicle 1 {text}", "time": when} | said


def test_what_an_autopilot_calls_critical_is_an_alarm_with_name_and_time(browser):
    zone = {"timezone_id": "Europe/Zurich"}
    with standing(vehicle(1, name="Falcon")) as station, opened(browser, station.url, **zone) as page:
        page.wait_for_selector(".tile")
        send(page, event("text", "Mission: 3 WP", 6))
        send(page, event("text", "GPS Glitch or Compass error", 4))
        for text, severity in (("Crash: Disarming: AngErr=92>30", 0), ("Fence Breached", 2), ("EKF variance", 3)):
            send(page, event("text", text, severity))
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length === 3")
        clock = "2026-05-28 22:26:41 UTC+2"
        assert texts(page)[0] == f"DANGER {clock} Falcon: its autopilot says: Crash: Disarming: AngErr=92>30"
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        send(page, event("text", "Fence Breached", 2))  # said again at once: the same alarm
        send(page, event("text", "Battery 1 failsafe: RTL", 2))
        page.wait_for_selector(".alarms:has-text('Battery 1 failsafe')")
        assert len(texts(page)) == 1


def test_checks_before_arming_are_no_alarms_and_what_was_said_before_the_page_is(browser):
    now = time.time()
    said = [
        {"text": "Crash: Disarming", "severity": 0, "time": round(now - 30.0, 1)},
        {"text": "PreArm: GPS not healthy", "severity": 2, "time": round(now - 5.0, 1)},
        {"text": "Fence Breached", "severity": 2, "time": round(now - 4000.0, 1)},
    ]
    with standing(vehicle(1, armed=False, texts=said)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('Crash: Disarming')")
        assert len(texts(page)) == 1
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        send(page, {"type": "hello", "time": now})  # everything is read again
        page.wait_for_timeout(1500)
        assert texts(page) == []


def test_a_restart_in_the_air_and_a_mission_that_ends_early_are_alarms(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile")
        send(page, event("rebooted"))
        send(page, event("aborted"))
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length === 2")
        assert texts(page)[0].startswith("DANGER") and texts(page)[0].endswith("v1: has restarted in the air")
        assert texts(page)[1].endswith("v1: has ended its mission without completing it")
        seen(page)
        change(page, armed=False, flight={"state": "on ground", "text": "on ground"})
        page.wait_for_selector(".word:has-text('on ground')")
        send(page, event("rebooted"))
        page.wait_for_timeout(500)
        assert texts(page) == []


def aircraft(metres_north, alt_m):
    return {
        "id": "4b1234", "name": "REGA1", "lat_deg": 47.3977 + metres_north / 111_200, "lon_deg": 8.546, "alt_m": alt_m,
    }  # fmt: skip


def test_an_aircraft_near_a_vehicle_in_the_air_is_a_danger(browser):
    with standing(vehicle(1, alt_m=568.0)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile")
        for row, words in (
            (aircraft(100.0, 600.0), "32 m above it"),
            (aircraft(100.0, 500.0), "68 m below it"),
            (aircraft(100.0, None), "not known"),
        ):
            send(page, {"type": "traffic", "rows": [row]})
            page.wait_for_selector(f".alarms:has-text('{words}')")
            assert texts(page)[0].startswith("DANGER v1: aircraft REGA1 is 100.0 m away and ")
        for row in (aircraft(100.0, 800.0), aircraft(700.0, 568.0)):
            send(page, {"type": "traffic", "rows": [row]})
            page.wait_for_selector(".alarms", state="hidden")
            send(page, {"type": "traffic", "rows": [aircraft(100.0, 600.0)]})
            page.wait_for_selector(".alarms")
        change(page, armed=False, flight={"state": "on ground", "text": "on ground"})
        page.wait_for_selector(".alarms", state="hidden")
