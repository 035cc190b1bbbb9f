"""Commands: always on the screen, confirmed once, and each ends visibly."""

import contextlib
import re
import threading

import pytest

from tests.kit.page_kit import DESK, PHONE, TABLET, ok_for_all, opened, poll, send, standing, vehicle

ALL = ("pause", "rtl", "land")
PLURAL = re.compile(r"\b1 (vehicle|picture|satellite|corner|flight|leg|gap|job|item|alarm|polygon)s\b")


def confirm(page):
    page.wait_for_timeout(400)  # a press within a third of a second is a double press
    page.click(".confirm-yes")


def outcomes(page) -> list[str]:
    return page.locator(".outcomes .outcome").all_inner_texts()


@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_commands_to_all_are_on_the_screen_in_every_mode(browser, size):
    with standing(*(vehicle(k) for k in range(1, 31))) as station, opened(browser, station.url, size) as page:
        for mode in ("plan", "fly", "map"):
            page.click(f"#tab-{mode}")
            for verb in ALL:
                box = page.locator(f".command[data-verb={verb}]").bounding_box()
                assert box["height"] >= 44
                assert box["x"] >= 0 and box["x"] + box["width"] <= size[0]
                assert box["y"] + box["height"] <= size[1]
                hit = "([x, y]) => document.elementFromPoint(x, y).closest('.command')?.dataset.verb"
                assert page.evaluate(hit, [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]) == verb
            stage = page.locator("#stage").bounding_box()
            if size == PHONE:
                assert stage["height"] >= 2 / 3 * size[1]


@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_a_dialog_leaves_the_commands_in_reach(browser, size):
    with standing(vehicle(1)) as station, opened(browser, station.url, size) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile")
        page.click("header .icon")
        page.wait_for_selector("dialog[open]")
        shown, bar = (page.locator(name).bounding_box() for name in ("dialog[open]", ".command-bar"))
        assert shown["y"] >= 0 and shown["y"] + shown["height"] <= bar["y"]
        page.click(".command[data-verb=rtl]")
        confirm(page)
        page.wait_for_selector("[data-outcome=done]")
        assert len(station.commands("rtl")) == 1
        assert page.evaluate("document.querySelector('#map').inert")
        page.focus("dialog[open] select")
        page.keyboard.press("Escape")
        page.wait_for_selector("dialog[open]", state="detached")
        assert not page.evaluate("document.querySelector('#map').inert")
        assert page.evaluate("document.activeElement.className") == "icon"


def test_one_press_and_one_confirmation_send_once_to_all(browser):
    with standing(vehicle(1), vehicle(2)) as station, opened(browser, station.url) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile >> nth=1")
        page.dblclick(".command[data-verb=land]")
        assert station.commands("land") == []  # a double press is not a confirmation
        confirm(page)
        page.wait_for_function("() => document.querySelectorAll('[data-outcome=done]').length == 2")
        assert [path for _, path, _ in station.heard] == ["/api/missions/all/land"]
        body = station.commands("land")[0]
        assert body["id"]
        assert abs(body["given_s"] - page.evaluate("Date.now() / 1000")) < 3600


def test_a_finger_holds_for_a_second(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, PHONE, has_touch=True) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile")
        page.locator(".command[data-verb=land]").tap()
        page.wait_for_timeout(400)
        page.locator(".confirm-yes").tap()
        page.wait_for_timeout(300)
        assert station.commands("land") == []
        box = page.locator(".confirm-yes").bounding_box()
        session = page.context.new_cdp_session(page)
        point = {"x": box["x"] + 20, "y": box["y"] + 20}
        session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [point]})
        page.wait_for_selector("[data-outcome=done]")
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        assert len(station.commands("land")) == 1


def test_keys_command_and_give_the_focus_back(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile")
        page.focus(".command[data-verb=pause]")
        page.keyboard.press("Enter")
        page.wait_for_timeout(400)
        assert page.evaluate("document.activeElement.className") == "confirm-no"
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        page.wait_for_selector("[data-outcome=done]")
        assert page.evaluate("document.activeElement.dataset.verb") == "pause"
        page.keyboard.press("Enter")
        page.keyboard.press("Escape")
        page.wait_for_selector(".confirm", state="hidden")
        assert len(station.commands("pause")) == 1


def test_commands_carry_the_stations_steady_clock_and_follow_a_wall_clock_that_was_set_back(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile")
        page.evaluate("station.beats = false")
        for shift in (0, -30, -30, -30):  # nothing was held up: the clock was set
            page.evaluate(
                "(s) => station.send({ type: 'heartbeat', time: 1e9 + s + performance.now() / 1000,"
                " clock_s: 5000 + performance.now() / 1000, run: 'a' })",
                shift,
            )
        clock = "performance.now() / 1000"
        before = page.evaluate(clock)
        page.click(".command[data-verb=land]")
        confirm(page)
        page.wait_for_selector("[data-outcome=done]")
        body, now = station.commands("land")[0], page.evaluate(clock)
        assert body["run"] == "a"
        assert before - 1 < body["given_clock_s"] - 5000 < now + 1
        assert before - 1 < body["given_s"] - (1e9 - 30) < now + 1


@pytest.mark.parametrize("key", ["Enter", "Space"])
def test_a_key_that_is_held_down_lands_nobody(browser, key):
    with standing(vehicle(1), vehicle(2)) as station, opened(browser, station.url) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile >> nth=1")
        page.focus(".command[data-verb=land]")
        for _ in range(30):
            page.keyboard.down(key)  # the first is a press, the others are its repeats
            page.wait_for_timeout(50)
        page.keyboard.up(key)
        page.wait_for_selector(".confirm")
        # the question was opened with a mouse while the key was down, and the focus is on the confirmation
        page.click(".confirm-no")
        page.keyboard.down(key)
        page.click(".command[data-verb=land]")
        page.focus(".confirm-yes")
        page.wait_for_timeout(400)
        for _ in range(5):
            page.keyboard.down(key)
        page.keyboard.up(key)
        page.wait_for_timeout(300)
        assert station.commands("land") == []
        page.click(".confirm-no")
        page.focus(".command[data-verb=land]")
        page.keyboard.press(key)
        page.wait_for_timeout(400)
        page.keyboard.press("ArrowLeft")
        page.keyboard.press(key)
        page.wait_for_function("() => document.querySelectorAll('[data-outcome=done]').length == 2")
        assert len(station.commands("land")) == 1


@pytest.mark.parametrize(
    ("outcome", "word"), [("refused", "REFUSED"), ("not_sent", "NOT SENT"), ("unknown", "UNKNOWN")]
)
def test_what_was_not_done_stays_on_the_screen_with_its_reason(browser, outcome, word):
    with standing(vehicle(1, name="Falcon")) as station, opened(browser, station.url) as page:
        ok_for_all(station, outcome, "the battery is empty")
        page.click(".tile")
        page.click(".details [data-verb=rtl]")
        assert "Falcon" in page.inner_text(".confirm")
        confirm(page)
        page.wait_for_selector(f"[data-outcome={outcome}]")
        assert outcomes(page) == [word]
        assert "the battery is empty" in page.inner_text(".outcomes")
        assert "Falcon" in page.inner_text(".outcomes")


@pytest.mark.slow
def test_a_station_that_never_answers_makes_the_outcome_unknown(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        gate = threading.Event()
        station.answer = lambda *_: (gate.wait(30), (200, {}))[1]
        page.click(".tile")
        page.evaluate("station.beats = false")
        page.click(".details [data-verb=rtl]")
        confirm(page)
        page.wait_for_selector("[data-outcome=unknown]")
        assert "remote control" in page.inner_text(".outcomes")
        gate.set()


def test_a_station_that_is_gone_sends_nothing_and_says_so(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.click(".tile")
        page.route("**/api/missions/**", lambda route: route.abort("connectionrefused"))
        page.evaluate("station.beats = false; station.sockets.forEach((s) => s.close())")
        page.click(".details [data-verb=pause]")
        confirm(page)
        page.wait_for_selector("[data-outcome=not_sent]")


def test_commands_of_other_pages_are_shown(browser):
    with standing(vehicle(1, name="Falcon")) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile")
        send(
            page,
            {"type": "command", "id": "x", "vehicle": "v1", "command": "rtl", "outcome": "refused", "reason": "busy"},
        )
        page.wait_for_selector("[data-outcome=refused]")
        assert "Falcon: Return" in page.inner_text(".outcomes")


def test_red_items_stop_a_start_until_each_is_allowed(browser):
    part = {
        "id": "v1",
        "length_m": 900.0,
        "time_s": 312,
        "photos": 40,
        "sorties": 1,
        "turns": 4,
        "flights": [{"start_s": 0}],
    }
    plan = {
        "id": "plan-1",
        "covered_share": 0.99,
        "makespan_s": 312,
        "spacing_m": 20,
        "vehicles": [part],
        "warnings": [],
    }
    checks = [{"vehicle": "v7", "state": "red", "height_m": 80, "time_s": 312, "start_s": 0, "items": [
        {"name": "link", "state": "ok", "reason": "heard 0.1 s ago"},
        {"name": "battery", "state": "red", "reason": "0 % left, the mission needs about 40 %"},
        {"name": "gps", "state": "red", "reason": "no 3D fix"}]}]  # fmt: skip
    shared = {"area": None, "settings": {}, "plan": "plan-1", "vehicles": {"v1": "v7"}, "version": 1}
    with standing(vehicle(7, name="Falcon")) as station:
        station.gets |= {"/api/plan": shared, "/api/plans": [plan], "/api/plans/plan-1/map": {"features": []}}
        station.answer = lambda method, path, body: (
            (200, {"checks": checks}) if path.endswith("preflight") else (202, {"takeoffs_in_s": {"v7": 0}})
        )
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.click("text=Check and start")
            page.wait_for_selector(".checks section")
            words = page.inner_text("dialog[aria-labelledby=preflight-title]")
            for said in ("Falcon flies Route A", "80 m", "5:12", "0 % left, the mission needs about 40 %"):
                assert said in words
            start = page.locator("dialog[aria-labelledby=preflight-title] .primary")
            assert start.is_disabled()
            boxes = page.locator(".checks input:visible")
            assert boxes.count() == 2
            colour = "(e) => getComputedStyle(e).color"
            well, bad = (
                page.locator(f".checks li[data-level={level}] > b").first.evaluate(colour) for level in ("ok", "red")
            )
            assert well != bad  # OK is not red because another item is
            boxes.nth(0).check()
            assert start.is_disabled()
            boxes.nth(1).check()
            start.click()
            page.wait_for_selector("dialog[aria-labelledby=preflight-title]", state="hidden")
            assert station.commands("start")[0]["override"] == {"v7": ["battery", "gps"]}


@pytest.mark.slow
def test_a_red_item_that_becomes_well_lets_the_start_go_without_a_press(browser):
    """ArduCopter's position filter is ready 40 s after its start; the battery stays as it is."""
    part = {"id": "v1", "time_s": 312, "photos": 40, "sorties": 1, "flights": [{"start_s": 0}]}
    plan = {
        "id": "plan-1",
        "covered_share": 1.0,
        "makespan_s": 312,
        "spacing_m": 20,
        "vehicles": [part],
        "warnings": [],
    }
    shared = {"area": None, "settings": {}, "plan": "plan-1", "vehicles": {"v1": "v7"}, "version": 1}
    states = ["red", "ok", "red"]

    def answer(method, path, body):
        items = [
            {"name": "ekf", "state": states[0], "reason": "no position yet"},
            {"name": "battery", "state": "red", "reason": "0 % left"},
        ]
        return 200, {"checks": [{"vehicle": "v7", "state": "red", "height_m": 80, "time_s": 312, "items": items}]}

    with standing(vehicle(7, name="Falcon")) as station:
        station.gets |= {"/api/plan": shared, "/api/plans": [plan], "/api/plans/plan-1/map": {"features": []}}
        station.answer = answer
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.click("text=Check and start")
            start = page.locator("dialog[aria-labelledby=preflight-title] .primary")
            boxes = page.locator(".checks input:visible")
            page.wait_for_selector(".checks input:visible >> nth=1")
            boxes.nth(0).check()
            boxes.nth(1).check()
            assert start.is_enabled()
            boxes.nth(0).uncheck()
            boxes.nth(1).focus()
            page.click("text=Check again")
            boxes.nth(1).focus()
            states.pop(0)
            page.wait_for_function("() => !document.querySelector('.preflight .primary').disabled")
            assert "Battery" in page.evaluate("document.activeElement.closest('li').textContent")
            assert boxes.count() == 1 and boxes.nth(0).is_checked()
            states.pop(0)
            page.click("text=Check again")
            page.wait_for_selector(".checks input:visible >> nth=1")
            assert not boxes.nth(0).is_checked() and start.is_disabled()  # red again: it is asked again


@contextlib.contextmanager
def ready_to_start(browser, answer):
    """The dialog before a start in which all is well; `answer` answers what follows."""
    part = {"id": "v1", "time_s": 312, "photos": 40, "sorties": 1, "flights": [{"start_s": 0}]}
    plan = {"id": "plan-1", "covered_share": 1.0, "makespan_s": 312, "spacing_m": 20, "vehicles": [part]}
    shared = {"area": None, "settings": {}, "plan": "plan-1", "vehicles": {"v1": "v7"}, "version": 1}
    checks = [{"vehicle": "v7", "state": "ok", "height_m": 80, "time_s": 312, "items": []}]
    with standing(vehicle(7, name="Falcon")) as station:
        station.gets |= {"/api/plan": shared, "/api/plans": [plan], "/api/plans/plan-1/map": {"features": []}}
        station.answer = lambda method, path, body: (
            (200, {"checks": checks}) if path.endswith("preflight") else answer(method, path, body)
        )
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.click("text=Check and start")
            page.wait_for_function("() => !document.querySelector('.preflight .primary').disabled")
            yield station, page


@pytest.mark.slow
@pytest.mark.parametrize("received", [True, False], ids=["received", "not received"])
def test_a_start_whose_answer_is_lost_is_not_called_none(browser, received):
    lost, reached = threading.Event(), threading.Event()

    def answer(method, path, body):
        if path.endswith("/start"):
            reached.set()
            lost.wait(30)
            if received:
                return 202, {"takeoffs_in_s": {"v7": 0}}
            return 409, {"detail": "it was given 9 s ago, too long to be executed now; no vehicle was started"}
        return 404, {}

    with ready_to_start(browser, answer) as (station, page):
        page.route("**/start", lambda route: route.abort("connectionreset"), times=1)
        page.click(".preflight .primary")
        page.wait_for_selector(".notice:has-text('It is not known whether the start was received: keep away')")
        assert page.locator("dialog[open]").count() == 0  # the tiles can be seen
        assert "No vehicle was started" not in page.inner_text("body")
        assert reached.wait(60)
        lost.set()
        words = "Started: Falcon" if received else "No vehicle was started: it was given 9 s ago"
        page.wait_for_selector(f".notice:has-text('{words}')")
        assert page.locator(".notice:has-text('It is not known')").count() == 0
        assert station.commands("start")[0]["id"]


def test_cancel_during_a_start_takes_it_back_at_the_station(browser):
    gate = threading.Event()
    paused = [{"id": "x", "vehicle": "v7", "command": "pause", "outcome": "done", "reason": ""}]
    results = [[], paused]

    def answer(method, path, body):
        if method == "DELETE":
            return 200, {"results": results.pop(0)}
        gate.wait(240)
        return 202, {"takeoffs_in_s": {"v7": 0}}

    with ready_to_start(browser, answer) as (station, page):
        for leave, words in (
            (lambda: page.click(".preflight >> text=Cancel the start"), "The start was cancelled: no vehicle"),
            (lambda: page.keyboard.press("Escape"), "Pause was sent, Falcon: done"),
        ):
            page.click(".preflight .primary")
            page.wait_for_selector(".preflight >> text=Starting")
            page.focus(".preflight .row button:enabled")
            poll(page, lambda: station.commands("start"))  # the station has it
            leave()
            page.wait_for_selector(f".notice:has-text('{words}')")
            start, cancel = [body["id"] for method, path, body in station.heard if path.endswith("/start")]
            assert start == cancel
            station.heard.clear()
            page.click("text=Check and start")
            page.wait_for_function("() => !document.querySelector('.preflight .primary').disabled")
        gate.set()


def test_on_a_phone_the_panel_can_be_made_taller_and_the_scale_is_free(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, PHONE) as page:
        page.click("#tab-plan")
        low = page.locator("#side").bounding_box()["height"]
        assert low <= PHONE[1] / 3
        page.click("button[aria-label='Taller panel']")
        tall = page.locator("#side").bounding_box()["height"]
        assert tall > 0.4 * PHONE[1]
        page.click("button[aria-label='Lower panel']")
        assert page.locator("#side").bounding_box()["height"] == low
        scale = page.locator(".maplibregl-ctrl-scale").bounding_box()
        fold = page.locator(".grow").bounding_box()
        assert scale["x"] + scale["width"] <= fold["x"]


def test_one_is_said_in_the_singular(browser):
    """Every text of the page with 1 for each of its values: no "1 vehicles"."""
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        texts = page.evaluate("""async () => {
          const { t } = await import("/static/core/strings.js");
          const { english } = await import("/static/core/english.js");
          const ones = new Proxy({}, { get: () => 1 });
          return Object.keys(english).map((key) => t(key, ones));
        }""")
        assert len(texts) > 300
        assert [text for text in texts if PLURAL.search(text)] == []
        page.click(".command[data-verb=pause]")
        assert page.inner_text("#confirm-question").startswith("Pause 1 vehicle where it is?")


def test_vehicles_of_one_start_can_return_one_after_the_other(browser):
    near = [vehicle(k, home=[47.3977, 8.5456 + 4e-5 * k], returns_after=["v1"] if k == 2 else None) for k in (1, 2)]
    with standing(*near) as station, opened(browser, station.url) as page:
        ok_for_all(station)
        page.wait_for_selector(".tile .word:has-text('holds, returns after v1')")
        page.click(".command[data-verb=rtl]")
        assert "may meet there" in page.inner_text("#confirm-question")
        page.wait_for_timeout(400)
        page.keyboard.press("ArrowRight")
        assert page.inner_text("*:focus").startswith("One by one")  # recommended, and the first
        page.keyboard.press("Enter")
        page.wait_for_function("() => document.querySelectorAll('[data-outcome=done]').length == 2")
        assert [path for _, path, _ in station.heard] == ["/api/missions/all/return"]
        page.click(".command[data-verb=land]")
        assert not page.locator(".confirm-other").is_visible()  # landing has no order
        page.keyboard.press("Escape")
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.click(".command[data-verb=rtl]")
        assert not page.locator(".confirm-other").is_visible()
