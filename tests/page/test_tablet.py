"""Gloves, a patchy network, a tablet that slept: nothing is commanded, planned or believed by mistake."""

import json
import time

import pytest

from tests.kit.page_kit import PHONE, TABLET, ok_for_all, opened, poll, saved, send, standing, vehicle

GROUND = {"state": "on ground", "text": "on ground", "item": 0, "items": 0}
RINGS = "import('/static/plan/area.js').then((m) => m.area.rings.map((ring) => ring.length))"
EMPTY_PLAN = {"version": 1, "area": None, "settings": {}, "plan": None, "vehicles": {}}


def touches(page):
    """Sends touches: kind, then the places of all fingers."""
    session = page.context.new_cdp_session(page)

    def touch(kind, *places):
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    return touch


def tap_twice(page, x, y):
    """A double tap by the times of its touches, however long the page takes for each."""
    session, now = page.context.new_cdp_session(page), time.time()
    for kind, after_s in (("touchStart", 0.0), ("touchEnd", 0.02), ("touchStart", 0.08), ("touchEnd", 0.1)):
        points = [{"x": x, "y": y}] if kind == "touchStart" else []
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points, "timestamp": now + after_s})


def ask_to_land(page):
    """Opens the question; gives the middle of the button to hold."""
    page.wait_for_selector(".tile")
    page.locator(".command[data-verb=land]").tap()
    page.wait_for_timeout(400)
    box = page.locator(".confirm-yes").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def keep_plans(station):
    """The station keeps the plan as the daemon does."""
    station.gets["/api/plan"] = EMPTY_PLAN

    def answer(method, path, body):
        if path == "/api/plan":
            version = station.gets["/api/plan"]["version"]
            if body.get("version", version) != version:
                return 409, {"detail": f"the plan was changed elsewhere (version {version})"}
            station.gets["/api/plan"] = body | {"version": version + 1}
            return 200, station.gets["/api/plan"]
        return 200, {}

    station.answer = answer


def announce_elsewhere(station, page, **changes):
    """Another page has changed the plan; this one hears it."""
    now = station.gets["/api/plan"]
    station.gets["/api/plan"] = now | {"version": now["version"] + 50} | changes
    send(page, {"type": "plan"})


def change_elsewhere(station, page, shown, **changes):
    """Another page has changed the plan, after all of this one was saved; waits until it is so here (JavaScript)."""
    saved(page)
    announce_elsewhere(station, page, **changes)
    poll(page, lambda: page.evaluate(shown))


def field(name, value):
    return f"document.querySelector('[name={name}]').value === '{value}'"


def rings(*corners):
    """Whether the first rings of the area have so many corners."""
    return f"{RINGS}.then((rings) => `${{rings.slice(0, {len(corners)})}}` === '{','.join(map(str, corners))}')"


def test_a_tap_of_two_fingers_is_no_hold(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET, has_touch=True) as page:
        ok_for_all(station)
        x, y = ask_to_land(page)
        touch = touches(page)
        touch("touchStart", (x - 20, y))
        touch("touchStart", (x - 20, y), (x + 20, y))
        touch("touchEnd")
        page.wait_for_timeout(1500)
        assert station.commands("land") == []
        touch("touchStart", (x, y))  # one finger still does it
        page.wait_for_selector("[data-outcome=done]")
        assert len(station.commands("land")) == 1


def test_a_hold_confirms_only_the_question_that_it_began_with(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET, has_touch=True) as page:
        ok_for_all(station)
        x, y = ask_to_land(page)
        touches(page)("touchStart", (x, y))
        page.evaluate("document.querySelector('.command[data-verb=pause]').click()")
        page.wait_for_timeout(1500)
        assert station.commands("land") == station.commands("pause") == []


@pytest.mark.parametrize("typed, height", [("62,5", 62.5), ("62.5", 62.5), ("1,000", None), ("6o", None)])
def test_a_decimal_comma_is_understood_and_never_dropped(browser, typed, height):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        keep_plans(station)
        page.click("#tab-plan")
        corners = [[8, 47], [8.01, 47], [8, 47.01]]
        page.evaluate("(c) => import('/static/plan/area.js').then((m) => m.change((rings) => rings.push(c)))", corners)
        page.fill("[name=altitude_m]", "")
        page.click("[name=altitude_m]")
        page.keyboard.type(typed)
        page.click("text=Make plan")
        page.wait_for_selector(".notice")  # this station plans nothing
        sent = [body["altitude_m"] for _, path, body in station.heard if path == "/api/plans"]
        assert sent == ([] if height is None else [height])


def test_another_page_does_not_write_between_the_digits_that_somebody_types(browser):
    with standing(vehicle(1)) as station:
        keep_plans(station)
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.fill("[name=altitude_m]", "12")
            change_elsewhere(station, page, field("vehicles", 4), settings={"altitude_m": 80, "vehicles": "4"})
            page.keyboard.type("0")
            assert page.input_value("[name=altitude_m]") == "120"


def test_who_flies_what_follows_another_page(browser):
    parts = [{"id": i, "length_m": 9, "time_s": 9, "photos": 1, "sorties": 1, "flights": []} for i in ("v1", "v2")]
    plan = {"id": "p1", "vehicles": parts, "covered_share": 1, "makespan_s": 9, "warnings": [], "spacing_m": 9}
    with standing(vehicle(1), vehicle(2)) as station:
        keep_plans(station)
        station.gets["/api/plan"] = EMPTY_PLAN | {"plan": "p1", "vehicles": {"v1": "v1", "v2": "v2"}}
        station.gets |= {"/api/plans": [plan], "/api/plans/p1/map": {"features": []}}
        checks = [{"vehicle": v, "state": "ok", "items": [], "height_m": 50, "time_s": 9} for v in ("v1", "v2")]
        station.answer = lambda method, path, body: (200, {"checks": checks})
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.wait_for_selector(".assignments li >> nth=1")
            page.click("text=Check and start…")
            page.wait_for_selector("text=Start 2 vehicles")
            chosen = "[...document.querySelectorAll('.assignments select')].map((box) => box.value).join() === 'v2,v1'"
            change_elsewhere(station, page, chosen, vehicles={"v1": "v2", "v2": "v1"})
            page.click("text=Start 2 vehicles")
            page.wait_for_selector("dialog[open] >> text=changed on another page")
            assert not any(path.endswith("/start") for _, path, _ in station.heard)


def test_what_is_being_drawn_survives_another_page_and_the_next_taps_count(browser):
    with standing(vehicle(1)) as station:
        keep_plans(station)
        with opened(browser, station.url, TABLET) as page:
            page.wait_for_selector(".vehicle")
            page.click("#tab-plan")
            page.get_by_role("button", name="Draw area").click()
            for place in ((500, 200), (800, 200)):
                page.mouse.click(*place)
                page.wait_for_timeout(500)
            change_elsewhere(station, page, field("altitude_m", 90), settings={"altitude_m": 90})
            page.mouse.click(800, 450)
            poll(page, lambda: page.evaluate(rings(3)))
            assert page.input_value("[name=altitude_m]") == "90"


OUTLINE = [[8.544, 47.396], [8.547, 47.396], [8.547, 47.399], [8.544, 47.399], [8.544, 47.396]]
ZONE = [[8.545, 47.397], [8.5455, 47.397], [8.5455, 47.3975], [8.545, 47.397]]
ZONE_2 = [[8.546, 47.398], [8.5465, 47.398], [8.5465, 47.3985], [8.546, 47.398]]


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def tap_all(page, *places):
    for place in places:
        page.mouse.click(*place)
        page.wait_for_timeout(500)


def stored_rings(station):
    return station.gets["/api/plan"]["area"]["coordinates"]


@pytest.mark.parametrize("what", ["Add corners", "Add no-fly zone"])
def test_a_zone_of_another_page_stays_while_something_is_drawn_here(browser, what):
    """GIVEN a page that is drawing WHEN another draws zones before and between its taps THEN everything is kept."""
    with standing(vehicle(1)) as station:
        keep_plans(station)
        station.gets["/api/plan"] = EMPTY_PLAN | {"area": polygon(OUTLINE)}
        with opened(browser, station.url, TABLET) as page:
            page.wait_for_selector(".vehicle")
            page.click("#tab-plan")
            page.get_by_role("button", name=what).click()
            change_elsewhere(station, page, rings(4, 3), area=polygon(OUTLINE, ZONE))  # before any tap
            tap_all(page, (500, 200), (800, 200), (800, 450))
            saved(page)
            before = stored_rings(station)
            assert ZONE in before and len(before) == (2 if what == "Add corners" else 3)
            zones = f"{RINGS}.then((rings) => rings.length === {len(before) + 1})"
            change_elsewhere(station, page, zones, area=polygon(before[0], ZONE_2, *before[1:]))
            tap_all(page, (500, 450))
            page.click("button:text-is('Done')")
            saved(page)
            after = stored_rings(station)
            assert ZONE in after and ZONE_2 in after and len(after) == len(before) + 1
            drawn = after[0] if what == "Add corners" else next(r for r in after[1:] if r not in (ZONE, ZONE_2))
            assert len(drawn) - 1 == (8 if what == "Add corners" else 4)
            assert page.evaluate(RINGS) == [len(ring) - 1 for ring in after]


def test_a_tap_while_the_change_of_another_page_is_loaded_does_not_undo_it(browser):
    with standing(vehicle(1)) as station:
        keep_plans(station)
        station.gets["/api/plan"] = EMPTY_PLAN | {"area": polygon(OUTLINE)}
        with opened(browser, station.url, TABLET) as page:
            page.wait_for_selector(".vehicle")
            page.click("#tab-plan")
            page.get_by_role("button", name="Add corners").click()
            held = []
            page.route("**/api/plan", lambda r: held.append(r) if r.request.method == "GET" else r.continue_())
            station.gets["/api/plan"] |= {"version": 51, "area": polygon(OUTLINE, ZONE)}
            with page.expect_request("**/api/plan"):
                send(page, {"type": "plan"})
            page.mouse.click(800, 450)
            poll(page, lambda: held)
            held[0].fulfill(json=station.gets["/api/plan"])
            page.unroute("**/api/plan")
            poll(page, lambda: page.evaluate(rings(5, 3)))
            saved(page)
            assert ZONE in stored_rings(station) and len(stored_rings(station)[0]) == 6


# Counts the announcements that the page has dealt with: listeners run in the order in which they came.
HEARD = """import('/static/core/store.js').then((m) =>
  m.subscribe("plan", "a test", () => { window.heard = (window.heard ?? 0) + 1; }))"""


def test_a_change_of_another_page_while_one_is_saved_here_is_shown_afterwards(browser):
    """GIVEN a save that the station has taken WHEN another page changes the plan before its answer is here."""
    with standing(vehicle(1)) as station:
        keep_plans(station)
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.evaluate(HEARD)
            page.wait_for_function("window.heard > 0")
            held = []
            page.route(
                "**/api/plan", lambda r: held.append((r, r.fetch())) if r.request.method == "PUT" else r.continue_()
            )
            page.fill("[name=altitude_m]", "55")
            page.press("[name=altitude_m]", "Tab")
            poll(page, lambda: held)
            before = page.evaluate("window.heard")
            announce_elsewhere(station, page, settings={"altitude_m": 90})
            page.wait_for_function(f"window.heard > {before}")
            assert page.evaluate("import('/static/plan/shared.js').then((m) => m.isSaving())")
            assert page.input_value("[name=altitude_m]") == "55"  # it could not be loaded yet
            (route, answer), *_ = held
            route.fulfill(response=answer)
            page.wait_for_function(field("altitude_m", 90))


def test_a_plan_is_outdated_by_the_zone_of_another_page_also_while_something_is_drawn(browser):
    part = {"id": "v1", "length_m": 9, "time_s": 9, "photos": 1, "sorties": 1, "flights": []}
    plan = {"id": "p1", "vehicles": [part], "covered_share": 1, "makespan_s": 9, "warnings": [], "spacing_m": 9}
    drawn = "import('/static/plan/outdated.js').then((m) => m.drawnNow())"
    older = ".plan-result .wrong:has-text('The plan is older than the drawing')"
    with standing(vehicle(1)) as station:
        keep_plans(station)
        station.gets |= {"/api/plans": [plan], "/api/plans/p1/map": {"features": []}}
        station.gets["/api/plan"] = EMPTY_PLAN | {"area": polygon(OUTLINE)}
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.get_by_role("button", name="Add corners").wait_for()
            made_of = {"settings": {"made_of": page.evaluate(drawn)}, "plan": "p1", "vehicles": {"v1": "v1"}}
            change_elsewhere(station, page, "document.querySelector('.assignments li')", **made_of)
            assert page.locator(older).count() == 0
            page.get_by_role("button", name="Add corners").click()
            change_elsewhere(station, page, rings(4, 3), area=polygon(OUTLINE, ZONE))
            page.wait_for_selector(older)
            page.click("text=Check and start…")
            assert page.locator("dialog[open]").count() == 0


def test_a_double_tap_ends_a_drawing_with_that_corner(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET, has_touch=True) as page:
        page.wait_for_selector(".vehicle")
        page.click("#tab-plan")
        page.get_by_role("button", name="Draw area").tap()
        for place in ((500, 200), (800, 200), (800, 500)):
            page.wait_for_timeout(500)
            page.touchscreen.tap(*place)
        page.wait_for_timeout(500)
        tap_twice(page, 500, 500)
        page.get_by_role("button", name="Add corners").wait_for()
        assert page.evaluate(RINGS) == [4]


def change_without_a_network(page):
    page.click("#tab-plan")
    page.context.set_offline(True)
    page.fill("[name=altitude_m]", "55")
    page.press("[name=altitude_m]", "Tab")
    page.wait_for_selector("text=not shared with other pages")


def test_what_was_drawn_without_a_network_is_saved_when_it_is_back(browser):
    with standing(vehicle(1)) as station:
        keep_plans(station)
        with opened(browser, station.url, TABLET) as page:
            change_without_a_network(page)
            page.context.set_offline(False)
            poll(page, lambda: station.gets["/api/plan"]["settings"].get("altitude_m") == 55)


@pytest.mark.parametrize("status", [409, 507, 401])
def test_what_the_station_refuses_when_the_network_is_back_is_said(browser, status):
    with standing(vehicle(1)) as station:
        keep_plans(station)
        with opened(browser, station.url, TABLET) as page:
            change_without_a_network(page)
            station.answer = lambda method, path, body: (status, {"detail": "the station says no"})
            page.context.set_offline(False)
            page.wait_for_selector(".notice:has-text('not shared with other pages: the station says no')")


def test_a_refused_picture_does_not_ask_for_all_vehicles(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        page.wait_for_selector(".link[data-link=live]")
        page.wait_for_selector(".tile")
        page.wait_for_timeout(500)
        asked = []
        page.on("request", lambda request: asked.append(request.url))
        for count in range(3):
            send(
                page, {"type": "refused", "cause": "pose", "count": count, "vehicle": "v1", "image": "a", "reason": ""}
            )
        page.wait_for_timeout(500)
        assert [url for url in asked if url.endswith("/api/vehicles")] == []


def test_a_list_that_comes_late_does_not_put_a_flying_vehicle_on_the_ground(browser):
    with standing(vehicle(1, armed=False, flight=GROUND)) as station, opened(browser, station.url, TABLET) as page:
        page.wait_for_selector(".tile")
        old, held = json.dumps(station.gets["/api/vehicles"]), []
        page.route("**/api/vehicles", lambda route: held.append(route))
        for _ in range(3):  # a slow link: no request is sent before the last one was answered
            send(page, {"type": "vehicle_event", "vehicle": "v1", "kind": "found"})
            page.wait_for_timeout(2300)
        assert len(held) == 1
        flying = vehicle(1)["flight"]
        send(page, {"type": "vehicle", "id": "v1", "armed": True, "flight": flying, "silent_s": 0.1})
        page.wait_for_selector(".tile .word:has-text('on mission')")
        held[0].fulfill(body=old, content_type="application/json")
        page.wait_for_timeout(700)
        assert page.inner_text(".tile .word") == "on mission 7/13"
        page.unroute_all(behavior="ignoreErrors")


def test_after_a_sleep_nothing_old_is_shown_as_live(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        page.wait_for_selector(".link[data-link=live]")
        page.route("**/api/vehicles", lambda route: route.abort())
        page.evaluate("station.beats = false; const now = Date.now; Date.now = () => now() + 600e3;")
        page.wait_for_selector(".link[data-link=lost]")
        page.wait_for_selector(".tile .age:has-text('10:0')")


def test_a_wrong_token_is_named_where_the_page_gets_nothing(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        page.wait_for_selector(".link[data-link=live]")
        page.route("**/api/**", lambda route: route.fulfill(status=401, body='{"detail": "wrong token"}'))
        page.evaluate("station.beats = false; for (const socket of [...station.sockets]) socket.close();")
        page.wait_for_selector(".banner:has-text('The token is missing or wrong')")


@pytest.mark.parametrize("size", [TABLET, PHONE], ids=["tablet", "phone"])
def test_a_finger_reads_the_coordinates_of_a_mark_or_of_the_crossed_centre(browser, size):
    with standing(vehicle(1)) as station, opened(browser, station.url, size, has_touch=True) as page:
        page.wait_for_selector(".vehicle")
        page.wait_for_selector(".cursor:has-text('Centre 47.397700, 8.546000')")
        stage = page.locator("#stage").bounding_box()
        page.touchscreen.tap(stage["x"] + stage["width"] / 2 + 40, stage["y"] + stage["height"] / 2)
        page.wait_for_selector(".cursor:has-text('Mark 47.3977')")
        assert page.locator(".cross.marked").is_visible()
        page.evaluate("orthoswarm.map.jumpTo({ center: [8.6, 47.4] })")
        page.wait_for_selector(".cursor:has-text('Centre 47.400000, 8.600000')")
        assert not page.locator(".cross.marked").is_visible()
        page.evaluate("orthoswarm.map.jumpTo({ center: [181, -17] })")
        page.wait_for_selector(".cursor:has-text('Centre -17.000000, -179.000000')")
        page.locator(".cursor").tap()
        page.wait_for_selector(".notice:has-text('-17.000000, -179.000000')")


def test_an_area_across_the_meridian_of_180_degrees_keeps_its_corners(browser):
    corners = [[179.98, -17], [180.04, -17], [180.04, -17.02], [179.98, -17.02], [179.98, -17]]
    with standing(vehicle(1)) as station:
        station.gets["/api/plan"] = EMPTY_PLAN | {"area": {"type": "Polygon", "coordinates": [corners]}}
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.wait_for_selector(".hint:has-text('ha')")
            assert page.evaluate(RINGS) == [4]


def test_a_command_of_another_page_says_so(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        page.wait_for_selector(".tile")
        send(page, {"type": "command", "id": "x", "vehicle": "v1", "command": "rtl", "outcome": "done", "reason": ""})
        page.wait_for_selector(".outcomes >> text=from another page")


def test_a_press_wakes_the_sound_of_alarms(browser):
    silent = """window.sounds = []; window.AudioContext = class {
      constructor() { this.state = "suspended"; sounds.push(this); } resume() { this.state = "running"; } };"""
    with standing(vehicle(1, battery=0.05)) as station, opened(browser, station.url, TABLET) as page:
        page.add_init_script(silent)
        page.reload()
        page.wait_for_selector(".alarms >> text=battery 5 %")
        page.wait_for_function("sounds.length === 1 && sounds[0].state === 'suspended'")
        page.click("#tab-map")
        assert page.evaluate("sounds.map((sound) => sound.state)") == ["running"]
