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
        page.wait_for_selector(".alarms:has-text('WATCH v1: battery low')")
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
    rows = [vehicle(k, battery=0.1) for k in range(1, 10)]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('and 4 more')")
        first = texts(page)
        assert len(first) == 5
        seen(page)
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length === 4")
        assert not set(first) & set(texts(page))
        assert "more" not in page.inner_text(".alarms")
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")


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
    late = "is 12 s behind its plan, which keeps others apart for 8 s: watch its distances"
    with standing(vehicle(1, behind=late), vehicle(2)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('12 s behind its plan')")
        assert len(texts(page)) == 1
        send(page, {"type": "vehicle", "id": "v1", "system": 1, "behind": ""})
        page.wait_for_selector(".alarms", state="hidden")


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
