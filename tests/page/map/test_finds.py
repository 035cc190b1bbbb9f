"""A find shows the pictures that have it, and commands stay in reach meanwhile."""

import base64

from tests.kit.page_kit import DESK, PHONE, TABLET, ok_for_all, opened, send, standing, vehicle
from tests.page.test_command_bar import confirm

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def test_pictures_of_a_find_leave_commands_and_alarms_in_reach(browser):
    find = {
        "id": 1,
        "lat_deg": 47.3977,
        "lon_deg": 8.5456,
        "sigma_m": 0.4,
        "note": "Roof",
        "time": "2026-05-28T20:26:40Z",
    }
    ring = [[8.545, 47.398], [8.546, 47.398], [8.546, 47.397], [8.545, 47.397]]
    one = {"seq": 5, "vehicle": "v1", "column": 0.5, "row": 0.25, "stage": "fine", "outline": ring}
    shown = [one | {"image": f"{name}.jpg"} for name in "abcdefghijkl"]  # more than the box can show at once
    for size in (DESK, PHONE):
        with standing(vehicle(1, name="Falcon")) as station:
            station.gets |= {"/api/finds": [find], "/api/finds/1/pictures": shown}
            with opened(browser, station.url, size) as page:
                ok_for_all(station)
                page.route("**/api/frames/5/view*", lambda route: route.fulfill(body=PNG, content_type="image/png"))
                page.click("#tab-map")
                page.click(".finds >> text=Pictures")
                page.wait_for_selector(".pictures figcaption:has-text('a.jpg of Falcon')")
                page.wait_for_function("() => document.querySelector('.pictures i').style.left === '50%'")
                page.hover(".pictures figure >> nth=0")
                page.wait_for_function(
                    "() => window.orthoswarm.map.getSource('sighting')?.serialize().data.features.length === 1"
                )
                near = {"type": "vehicle_event", "kind": "near", "vehicle": "v1", "pair": ["v1", "v2"], "text": "near"}
                send(page, near)
                page.click(".alarms >> text=Seen")  # fails if the pictures lie over the alarms
                page.click(".command[data-verb=rtl]")
                confirm(page)
                page.wait_for_selector("[data-outcome=done]")
                page.click(".find-pictures button", trial=True)  # fails if the page's header lies over it
                page.focus(".find-pictures button")
                page.keyboard.press("Escape")
                page.wait_for_selector(".find-pictures", state="hidden")
                page.wait_for_function(
                    "() => window.orthoswarm.map.getSource('sighting').serialize().data.features.length === 0"
                )


def test_pictures_of_any_place_can_be_looked_at(browser):
    with standing(vehicle(1, name="Falcon")) as station, opened(browser, station.url) as page:
        one = {
            "seq": 5,
            "vehicle": "v1",
            "image": "a.jpg",
            "column": 0.5,
            "row": 0.25,
            "stage": "fine",
            "outline": None,
        }
        station.gets["/api/pictures"] = [one]
        page.route("**/api/frames/5/view*", lambda route: route.fulfill(body=PNG, content_type="image/png"))
        page.click("#tab-map")
        page.click("button:has-text('Pictures of a place')")
        with page.expect_request(lambda request: "/api/pictures?lat_deg=47." in request.url):
            page.mouse.click(900, 400)
        page.wait_for_selector(".pictures figcaption:has-text('a.jpg of Falcon')")


def test_the_ground_under_a_vehicle_can_be_marked(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        station.answer = lambda method, path, body: (200, {"id": 1} | body)
        page.wait_for_selector(".vehicle")
        page.click("#tab-map")
        page.fill("input[aria-label='Note of the marker']", "Under a vehicle")
        page.click("text=Mark on the map")
        box = page.locator("button.vehicle").bounding_box()
        with page.expect_request(lambda request: request.method == "POST" and request.url.endswith("/api/finds")):
            page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)


FIND = {"id": 1, "lat_deg": 47.3977, "lon_deg": 8.5456, "sigma_m": 2.0, "note": "Roof", "time": "2026-05-28T20:26:40Z"}


def test_a_find_says_how_far_off_it_may_be_or_that_this_is_not_known(browser):
    with standing(vehicle(1)) as station:
        station.gets["/api/finds"] = [FIND, FIND | {"id": 2, "sigma_m": None, "note": "Car"}]
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            page.wait_for_selector(".finds li:has-text('Roof') >> text=within 4.90 m (95 %)")
            page.wait_for_selector(".finds li:has-text('Car') >> text=accuracy not known")


def keep_finds(station, *rows):
    """The station keeps finds as the daemon does."""
    station.gets["/api/finds"] = list(rows)

    def answer(method, path, body):
        now = {row["id"]: row for row in station.gets["/api/finds"]}
        row = now.get(int(path.rsplit("/", 1)[1]))
        if method != "PUT" or row is None:
            return 404, {"detail": "there is no such find"}
        if body["version"] != row["version"]:
            return 409, {"detail": "the find was changed elsewhere"}
        now[row["id"]] = body | {"id": row["id"], "version": row["version"] + 1}
        station.gets["/api/finds"] = list(now.values())
        return 200, now[row["id"]]

    station.answer = answer


def edit(page, name, words):
    page.click(f".finds li:has-text('{name}') >> text=Edit")
    page.fill(".find-edit input", words)


def test_text_and_place_of_a_find_can_be_changed(browser):
    with standing(vehicle(1)) as station:
        keep_finds(station, FIND | {"version": 1}, FIND | {"id": 2, "note": "Car", "version": 1})
        with opened(browser, station.url, TABLET) as page:
            page.wait_for_selector(".vehicle")
            page.click("#tab-map")
            edit(page, "Roof", "Two persons")
            page.click(".find-edit >> text=Move")
            page.mouse.click(700, 300)
            wanted = page.evaluate("orthoswarm.map.unproject([700 - 320, 300 - 52]).toArray()")
            page.click(".find-edit >> text=Save")
            page.wait_for_selector(".finds li:has-text('Two persons') >> text=accuracy not known")
            page.wait_for_selector(".find-edit", state="detached")
            page.wait_for_selector("[aria-label='Marker: Two persons']")
            changed, other = station.gets["/api/finds"]
            assert (changed["id"], changed["time"], other["note"]) == (1, FIND["time"], "Car")
            assert abs(changed["lon_deg"] - wanted[0]) < 1e-6 and abs(changed["lat_deg"] - wanted[1]) < 1e-6
            edit(page, "Car", "Lorry")
            page.click(".find-edit >> text=Cancel")
            assert page.locator(".finds li:has-text('Car')").count() == 1 and station.gets["/api/finds"][1] == other


def test_a_find_that_two_pages_change_keeps_both_until_somebody_decides(browser):
    with standing(vehicle(1)) as station:
        keep_finds(station, FIND | {"version": 1})
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-map")
            edit(page, "Roof", "Mine")
            station.gets["/api/finds"] = [FIND | {"note": "Theirs", "version": 2}]
            page.click(".find-edit >> text=Save")
            page.wait_for_selector(".notice:has-text('changed on another page')")
            page.wait_for_selector(".finds li:has-text('Theirs')")
            assert page.input_value(".find-edit input") == "Mine"
            page.click(".find-edit >> text=Save")
            page.wait_for_selector(".finds li:has-text('Mine')")
            edit(page, "Mine", "Mine, too late")
            station.gets["/api/finds"] = []
            page.click(".find-edit >> text=Save")
            page.wait_for_selector(".notice:has-text('Mine, too late was removed on another page') >> text=Put back")


def test_a_find_that_was_removed_can_be_put_back(browser):
    with standing(vehicle(1)) as station:

        def answer(method, path, body):
            station.gets["/api/finds"] = [] if method == "DELETE" else [body | {"id": 2}]
            return 200, None

        station.gets["/api/finds"], station.answer = [FIND], answer
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-map")
            page.click("[aria-label='Remove this marker']")
            page.wait_for_selector(".finds li", state="detached")
            page.click("text=Put back")
            page.wait_for_selector(".finds li:has-text('Roof')")
            assert station.gets["/api/finds"] == [FIND | {"id": 2}]


def test_a_find_that_could_not_be_saved_keeps_its_place(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        station.answer = lambda method, path, body: (201, body)
        page.wait_for_selector(".vehicle")
        page.click("#tab-map")
        page.fill("input[aria-label='Note of the marker']", "Person")
        page.click("text=Mark on the map")
        page.context.set_offline(True)
        page.mouse.click(700, 300)
        page.wait_for_selector("text=Person was not saved")
        wanted = page.evaluate("orthoswarm.map.unproject([700 - 320, 300 - 52]).toArray()")
        page.context.set_offline(False)
        with page.expect_response(lambda response: response.request.method == "POST"):
            page.click("text=Save again")
        (_, _, saved) = station.heard[-1]
        assert saved["note"] == "Person"
        assert abs(saved["lon_deg"] - wanted[0]) < 1e-6 and abs(saved["lat_deg"] - wanted[1]) < 1e-6


def test_a_later_notice_is_seen_beside_those_that_wait_for_a_press(browser):
    with standing(vehicle(1)) as station:
        station.answer = lambda method, path, body: (200, None)
        station.gets["/api/finds"] = [FIND | {"id": k, "note": f"Roof {k}"} for k in range(4)]
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-map")
            page.wait_for_selector(".finds li >> nth=3")
            for k in range(4):
                page.locator(f".finds li:has-text('Roof {k}') [aria-label='Remove this marker']").click()
                page.wait_for_selector(f".notice:has-text('Roof {k}')")
            page.click("#tab-plan")
            page.click("text=Make plan")
            page.wait_for_selector(".notice:has-text('area')")
            assert page.locator(".notice").count() == 4
