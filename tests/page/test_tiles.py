"""Vehicle tiles: they survive any value, stay where they are, lose no press, and show how old they are."""

import time

import pytest

from tests.kit.page_kit import DESK, LIMIT_MS, PHONE, SOCKET, TABLET, opened, send, standing, vehicle

UPDATES = """() => {
  let k = 0;
  setInterval(() => {
    k++;
    for (let n = 1; n <= 96; n++) {
      const moving = { lat_deg: 47.39 + 1e-5 * (k % 100) * n, lon_deg: 8.54 + 1e-4 * n, height_m: 80 + (k % 10) };
      const figures = { silent_s: 0.1, speed_m_s: k % 9, battery: 0.5 + 0.001 * (k % 90) };
      station.send({ type: "vehicle", id: `v${n}`, system: n, ...moving, ...figures });
    }
  }, 100);
}"""
COUNT = """() => {
  window.presses = 0;
  for (const tile of document.querySelectorAll(".tile")) tile.addEventListener("click", () => { window.presses++; });
}"""
NONE = "\N{EN DASH}"
FOCUSED = "document.activeElement.closest('.tile').querySelector('b').textContent"
WILD = [
    {"type": "vehicle", "id": "v1", "lat_deg": 1e308}, {"type": "frame", "outline": 7}, {"type": "job"}, {},
    {"type": "vehicle_event", "vehicle": {}, "text": {}}, {"type": "alarm"}, {"type": "command"},
]  # fmt: skip


FENCE = {"kind": "exclusion", "center": [8.5456, 47.3977], "radius_m": 20}


def many():
    return [vehicle(k, name=f"Bird {k}") for k in range(1, 97)]


def press(page, times, hold_ms):
    page.evaluate(COUNT)
    page.evaluate(UPDATES)
    tiles = page.locator(".tile")
    spots = [b for b in (tiles.nth(k).bounding_box() for k in range(96)) if b["y"] + b["height"] < 780]
    names = page.locator(".tile b").all_inner_texts()
    for k in range(times):
        box = spots[k % len(spots)]
        page.mouse.move(box["x"] + 60, box["y"] + 30)
        page.mouse.down()
        page.wait_for_timeout(hold_ms)
        page.mouse.up()
        assert page.evaluate(FOCUSED) == names[k % len(spots)]
    for _ in range(times):
        page.keyboard.press("Enter")
    assert page.evaluate("window.presses") == 2 * times
    assert page.evaluate("document.activeElement.className") == "tile"  # the focus stayed


def test_no_press_is_lost_while_96_vehicles_send(browser):
    with standing(*many()) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=95")
        press(page, 60, 40)


def test_a_takeoff_that_was_waited_for_is_over_once_the_daemon_no_longer_names_it(browser):
    with standing(vehicle(1, takeoff={"in_s": 4.0})) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".word:has-text('takes off in')")
        station.gets["/api/vehicles"] = [vehicle(1)]
        send(page, {"type": "vehicle_event", "vehicle": "v1", "kind": "armed"})
        page.wait_for_selector(".word:has-text('on mission 7/13')")


@pytest.mark.slow
@pytest.mark.timeout(900)  # it holds each press for 0.12 s
def test_a_thousand_presses_arrive(browser):
    with standing(*many()) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=95")
        page.add_style_tag(content="#map { display: none }")  # drawn by software it takes most of the time
        press(page, 1000, 120)


def test_any_value_leaves_the_other_vehicles_in_command(browser):
    wild = [
        vehicle(1, lat_deg=1e9), vehicle(2, lat_deg=None, lon_deg="east", height_m=[], battery="full", flight=7),
        vehicle(3, name={"a": 1}, mission=None, frames="many", trail=[[1], None, "x", [900, 900]], texts=3),
        vehicle(4, heading_deg=None, silent_s=-5, gps_fix=99, satellites=1e300, takeoff=5), {"id": None}, 17, None,
    ]  # fmt: skip
    with standing(*wild, vehicle(5, name="Falcon")) as station:
        station.gets["/api/layers"] = [{"name": "fine", "version": 1, "empty": False, "bounds": [None, "x", 3, 4]}, 5]
        station.gets["/api/legs"] = {"features": [None, {"geometry": None}, 3]}
        station.gets["/api/jobs"] = [None, {"id": 1}, "x"]
        with opened(browser, station.url) as page:
            page.wait_for_selector(".tile:has-text('Falcon')")
            for event in WILD:
                send(page, event)
            page.evaluate(
                "station.sockets[0].onmessage({ data: 'no JSON' }); station.sockets[0].onmessage({ data: '3' })"
            )
            page.wait_for_timeout(500)
            assert page.locator(".tile").count() == 5
            page.click(".tile:has-text('Falcon')")
            page.wait_for_selector(".details [data-verb=rtl]")
            page.wait_for_selector(".vehicle:has-text('Falcon')")


def test_a_name_stays_when_news_leave_it_out(browser):
    with standing(vehicle(1, name="Falcon")) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile")
        for k in range(5):
            send(
                page, {"type": "vehicle", "id": "v1", "system": 1, "height_m": 10 + k, "lat_deg": 47.4, "lon_deg": 8.5}
            )
            page.wait_for_timeout(150)
            assert page.inner_text(".tile b") == "Falcon"
            assert page.inner_text(".vehicle span") == "Falcon"


@pytest.mark.slow
def test_silence_is_shown_with_its_age_and_a_banner(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile[data-level=ok]")
        assert page.locator(".banner").is_hidden()
        page.evaluate("station.beats = false")
        page.wait_for_selector(".tile[data-level=stale]")
        assert "not heard for" in page.inner_text(".tile .why")
        page.wait_for_selector(".banner")
        assert "commands may not arrive" in page.inner_text(".banner")
        assert page.inner_text(".link") == "Station lost"
        assert page.locator(".command[data-verb=rtl]").is_visible()
        page.evaluate("station.beats = true")
        page.wait_for_selector(".banner", state="hidden")


def test_tiles_keep_their_places_until_the_person_sorts(browser):
    with standing(*(vehicle(k) for k in range(1, 6))) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=4")
        names = page.locator(".tile b")
        send(page, {"type": "vehicle", "id": "v4", "system": 4, "battery": 0.05})
        page.wait_for_selector(".tile[data-level=bad]")
        assert names.all_inner_texts() == ["v1", "v2", "v3", "v4", "v5"]
        page.wait_for_selector(".alarms:has-text('DANGER v4')")
        page.select_option("select[aria-label=Order]", "need")
        assert names.all_inner_texts() == ["v4", "v1", "v2", "v3", "v5"]
        page.select_option("select[aria-label='Which vehicles']", "need")
        assert page.locator(".tile:visible").count() == 1


def test_the_map_is_not_repainted_when_nothing_changes(browser):
    with standing(vehicle(1), vehicle(2)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".vehicle >> nth=1")
        page.evaluate("setInterval(() => station.send({ type: 'vehicle', id: 'v1', system: 1, silent_s: 0.1 }), 100)")
        page.evaluate("window.paints = 0; orthoswarm.map.on('render', () => { window.paints++; })")
        for _ in range(10):  # what is drawn at the start ends by itself
            page.evaluate("window.paints = 0")
            page.wait_for_timeout(3000)
            if page.evaluate("window.paints") == 0:
                return
        raise AssertionError("the map is repainted all the time")


def test_what_came_before_the_map_was_there_is_shown(browser):
    layer = {"name": "fine", "version": 3, "empty": False, "bounds": [8.54, 47.39, 8.56, 47.41]}
    with standing(vehicle(1)) as station:
        station.gets["/api/layers"] = [layer]
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            page.wait_for_selector("[data-layer=fine][data-empty=false]")
            page.wait_for_function("() => orthoswarm.map.getZoom() > 12 && orthoswarm.map.getLayer('fine')")


def test_the_alarm_of_a_pair_ends_with_that_pair(browser):
    def event(kind, vehicle, *pair):
        return {"type": "vehicle_event", "kind": kind, "vehicle": vehicle, "pair": pair, "text": f"{pair} {kind}"}

    with standing(vehicle(1), vehicle(2), vehicle(3)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=2")
        send(page, event("near", "v1", "v1", "v2"))
        send(page, event("near", "v1", "v1", "v3"))  # two alarms, although one vehicle should be paused for both
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length == 2")
        send(page, event("apart", "v2", "v1", "v2"))
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length == 1")
        assert "v3" in page.inner_text(".alarms li")
        send(page, event("apart", "v3", "v1", "v3"))
        page.wait_for_selector(".alarms", state="hidden")


def test_the_page_has_no_fault_of_its_own_when_parts_of_it_come_late(browser):
    """On a slow machine vehicles are known before the strip is there."""
    with standing(vehicle(1)) as station:
        context = browser.new_context()
        page = context.new_page()
        page.set_default_timeout(LIMIT_MS)
        page.route("**/fly/alarms.js", lambda route: (time.sleep(1.5), route.continue_()))
        page.add_init_script(SOCKET)
        page.goto(station.url)
        page.wait_for_function("() => window.orthoswarm")
        page.wait_for_selector(".tile")
        page.wait_for_timeout(500)
        assert page.locator(".problems li").all_text_contents() == []
        context.close()


def test_the_details_show_home_and_what_the_autopilot_said_newest_first(browser):
    said = [{"text": "PreArm: GPS not healthy", "severity": 2, "time": 1_780_000_000.0}]
    with standing(vehicle(1, home=[47.398, 8.5456], texts=said)) as station, opened(browser, station.url) as page:
        page.click(".tile")
        page.wait_for_selector(".messages li[data-severity='2']:has-text('CRITICAL PreArm')")  # not its colour alone
        event = {"type": "vehicle_event", "vehicle": "v1", "kind": "text", "text": "vehicle 1 says: Mission: 3 WP",
                 "said": "Mission: 3 WP", "severity": 6, "time": 1_780_000_001.0}  # fmt: skip
        send(page, event)
        page.wait_for_function("() => document.querySelectorAll('.messages li').length == 2")
        send(page, {"type": "vehicle", "id": "v1", "silent_s": 0.1})  # what changed: nothing; what was said stays
        page.wait_for_timeout(500)
        texts = page.locator(".messages li").all_inner_texts()
        assert texts[0].endswith("Mission: 3 WP") and texts[1].endswith("PreArm: GPS not healthy")
        assert "47.398000, 8.545600" in page.inner_text(".details dl") and "m away" in page.inner_text(".details dl")


@pytest.mark.parametrize(
    ("zone", "read", "said"),
    [
        ("UTC", "2026-05-28 20:26 UTC", "2026-05-28 20:27:01 UTC WARNING PreArm: no fix"),
        ("Europe/Zurich", "2026-05-28 22:26 UTC+2", "2026-05-28 22:27:01 UTC+2 WARNING PreArm: no fix"),
        ("Asia/Kathmandu", "2026-05-29 02:11 UTC+5:45", "2026-05-29 02:12:01 UTC+5:45 WARNING PreArm: no fix"),
        ("America/St_Johns", "2026-05-28 17:56 UTC-2:30", "2026-05-28 17:57:01 UTC-2:30 WARNING PreArm: no fix"),
    ],
)
def test_a_time_says_its_zone(browser, zone, read, said):
    texts = [{"text": "PreArm: no fix", "time": 1_780_000_021.0, "severity": 4}]
    row = vehicle(1, texts=texts, fence={"zones": [FENCE], "read_s": 1_780_000_000.0})
    with standing(row) as station, opened(browser, station.url, timezone_id=zone) as page:
        page.click(".tile")
        page.wait_for_selector(f".details:has-text('read from the vehicle at {read}')")
        assert page.locator(".messages li").all_inner_texts() == [said]


def test_the_faults_of_a_link_are_said_and_none_where_there_are_none(browser):
    faults = {"lost_share": 0.12, "damaged": 1, "impossible": 3}
    good = vehicle(2, faults=dict.fromkeys(faults, 0))
    with standing(vehicle(1, faults=faults), good, vehicle(3)) as station, opened(browser, station.url) as page:
        page.click(".tile >> nth=0")
        page.wait_for_selector(".details dd:has-text('12 % of its packets lost lately; 1 packet damaged on its link')")
        page.wait_for_selector(".details dd:has-text('3 messages with impossible values left out')")
        for name in ("v2", "v3"):
            page.click(f".tiles li[data-id={name}] .tile")
            page.wait_for_selector(f".details h2:has-text('{name}')")
            page.wait_for_selector(".details dt:has-text('Link faults')", state="hidden")


def test_other_aircraft_are_on_the_map_while_they_are_heard(browser):
    row = {"id": "4b1803", "name": "SWR12", "lat_deg": 47.398, "lon_deg": 8.546, "alt_m": 900.0, "heading_deg": 90.0}
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        for rows in ([row, {"id": "x", "lat_deg": 900, "lon_deg": None}], [row | {"alt_m": None}]):
            send(page, {"type": "traffic", "rows": rows})
            page.wait_for_selector(".traffic")
            assert "SWR12" in page.inner_text(".traffic")
        assert page.locator(".traffic").count() == 1
        send(page, {"type": "traffic", "rows": []})
        page.wait_for_selector(".traffic", state="detached")


def test_a_vehicle_that_only_sends_pictures_shows_nothing_that_is_not_known(browser):
    row = {"id": "v7", "name": "Card", "lat_deg": 47.3977, "lon_deg": 8.5456, "frames": {"frames": 5}, "state": ""}
    with standing(row) as station, opened(browser, station.url) as page:
        page.click(".tile")
        assert "armed" not in page.inner_text(".details")
        assert page.inner_text(".tile .cells").split() == [NONE, "5/5", "pics"]
        assert page.locator(".details dd:visible").all_inner_texts().count(NONE) <= 2  # height, refined


def test_start_is_not_offered_in_the_air_and_the_details_do_not_cover_the_map(browser):
    ground = vehicle(2, armed=False, flight={"state": "on ground", "text": "on ground"})
    with standing(vehicle(1), ground) as station, opened(browser, station.url) as page:
        page.click(".tile >> nth=0")
        page.wait_for_selector(".details [data-verb=start]:disabled")
        assert page.is_enabled(".details [data-verb=rtl]")
        page.click(".tile >> nth=1")
        page.wait_for_selector(".details [data-verb=start]:enabled")
        page.click("#tab-map")
        page.wait_for_selector(".details", state="hidden")
        page.click(".vehicle >> nth=0")
        page.wait_for_selector(".details")  # asked for here
        page.click("#tab-fly")
        page.wait_for_selector(".details")


def test_the_geofence_that_a_vehicle_holds_is_drawn_and_its_source_is_said(browser):
    ring = [[8.545, 47.397], [8.547, 47.397], [8.547, 47.399]]
    zones = [
        {"kind": "inclusion", "ring": ring},
        {"kind": "exclusion", "center": [8.546, 47.398], "radius_m": 20.0},
        {"kind": "exclusion", "ring": [["x", 900]]},
    ]
    fence = {"zones": zones, "read_s": 1_780_000_000.0}
    rows = [vehicle(1, fence=fence), vehicle(2, fence=fence), vehicle(3, fence={"zones": []}), vehicle(4)]
    with standing(*rows) as station, opened(browser, station.url) as page:
        for number, words in enumerate(("1 to stay in, 1 to stay out of; read from", "1 to", "none on", "not read")):
            page.click(f".tile >> nth={number}")
            page.wait_for_selector(f".details dd:has-text('{words}')")
        drawn = "orthoswarm.map.getSource('fences').serialize().data.features.map((f) => f.properties.inside)"
        page.wait_for_function(f"() => JSON.stringify({drawn}) === '[true,false]'")


@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_what_a_tile_says_of_danger_covers_none_of_its_figures(browser, size):
    row = vehicle(1, battery=0.1, battery_left_s=95, gps_fix=2, satellites=14, photos=120, frames={"frames": 118})
    with standing(row) as station, opened(browser, station.url, size) as page:
        why = page.locator(".tile .why:has-text('land now')").bounding_box()
        for cell in page.locator(".tile .cell").all():
            box = cell.bounding_box()
            assert box["y"] + box["height"] <= why["y"] + 1, cell.inner_text()
        cells = "[...document.querySelectorAll('.tile .cell')].filter((e) => e.scrollWidth > e.clientWidth)"
        assert page.evaluate(f"{cells}.map((e) => e.innerText)") == []  # nothing is cut off


def test_one_vehicle_is_no_vehicles_and_no_height_is_minus_zero(browser):
    with standing(vehicle(1, height_m=-0.02)) as station, opened(browser, station.url) as page:
        page.wait_for_selector("text=1 vehicle, 1 in the air")
        assert page.inner_text(".tile .height") == "0 m"
        send(page, {"type": "vehicle"} | vehicle(2, height_m=-3.0))
        page.wait_for_selector("text=2 vehicles, 2 in the air")
        assert page.inner_text("li:nth-child(2) .tile .height") == "-3 m"


def test_a_vehicle_that_is_lost_counts_as_where_it_was_heard_last(browser):
    lost = {"state": "lost", "flight": {"state": "lost", "text": "lost"}, "silent_s": 60.0}
    rows = [
        vehicle(1, landed="in air", **lost),
        vehicle(2, landed="on ground", armed=False, **lost),
        vehicle(3, landed="", **lost),
    ]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector("text=3 vehicles, 2 in the air, 3 in danger")
        assert page.locator(".tile .word").all_inner_texts() == [
            "lost in the air",
            "lost on the ground",
            "lost in the air",
        ]
        for choice, names in (("air", ["v1", "v3"]), ("ground", ["v2"])):
            page.select_option("select[aria-label='Which vehicles']", choice)
            assert page.locator(".tile:visible b").all_inner_texts() == names


def test_a_vehicle_that_is_armed_on_the_ground_says_so(browser):
    ground = {"state": "on ground", "text": "on ground"}
    rows = [vehicle(1, flight=ground, mode="GUIDED"), vehicle(2, flight=ground, armed=False)]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile[data-level=warn]")
        assert page.locator(".tile .word").all_inner_texts() == ["ARMED on ground", "on ground"]
        assert page.locator(".tile .why").all_inner_texts() == ["armed: keep away", ""]
        page.wait_for_selector("text=2 vehicles, 0 in the air, 0 in danger, 1 to watch")
        page.wait_for_timeout(500)
        assert page.locator(".alarms").is_hidden()  # each takeoff begins so


@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_alarms_leave_the_details_and_their_commands_free(browser, size):
    rows = [vehicle(k, battery=0.05) for k in range(1, 9)]
    with standing(*rows) as station, opened(browser, station.url, size) as page:
        page.click(".tile >> nth=1")
        page.wait_for_selector(".alarms")
        page.wait_for_selector(".details h2")
        free = """(name) => [...document.querySelectorAll(name)].filter((e) => e.checkVisibility()).every((e) => {
          const { x, y, width, height } = e.getBoundingClientRect();
          return [0.05, 0.5, 0.95].every((k) => e.contains(document.elementFromPoint(x + k * width, y + height / 2)));
        })"""
        for name in (".details h2", ".details .close", ".details [data-verb=pause]", ".alarms button"):
            assert page.evaluate(free, name), name
