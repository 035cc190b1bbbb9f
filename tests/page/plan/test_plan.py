"""Plan mode: an area is drawn, changed, taken back and dropped; errors say what to change."""

import json
import time

import pytest

from gcs_plugin.web.uploads import area_of
from orthoswarm.model.errors import InputError
from tests.kit.page_kit import opened, refused, saved, standing, vehicle

HERE = "orthoswarm.map.jumpTo({ center: [8.5456, 47.3977], zoom: 16 })"
KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>
8.544,47.397,0 8.547,47.397,0 8.547,47.399,0 8.544,47.399,0 8.544,47.397,0</coordinates></LinearRing></outerBoundaryIs>
<innerBoundaryIs><LinearRing><coordinates>8.545,47.3975 8.546,47.3975 8.546,47.398 8.545,47.3975</coordinates>
</LinearRing></innerBoundaryIs></Polygon></Placemark></kml>"""


def planning(page):
    page.click("#tab-plan")
    page.evaluate(HERE)


def draw(page, *corners, what="Draw area"):
    page.click(f"text={what}")
    for x, y in corners:
        page.mouse.click(x, y)
        page.wait_for_timeout(350)
    page.click("button:text-is('Done')")


def corners(page) -> int:
    return page.locator(".handle:not(.middle)").count()


def test_corners_are_drawn_inserted_moved_deleted_and_taken_back(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        planning(page)
        draw(page, (600, 250), (900, 250), (900, 550), (600, 550))
        assert corners(page) == 4
        hint = page.inner_text(".hint")
        assert "ha" in hint
        page.locator(".handle.middle").first.focus()
        page.keyboard.press("Enter")
        assert corners(page) == 5
        page.keyboard.press("ArrowUp")
        assert page.inner_text(".hint") != hint
        page.keyboard.press("Delete")
        assert corners(page) == 4
        for _ in range(3):
            page.click("text=Undo")
        assert page.inner_text(".hint") == hint
        page.click("text=Redo")
        assert corners(page) == 5
        page.click("text=Undo")
        box = page.locator(".handle:not(.middle)").first.bounding_box()
        page.mouse.move(box["x"] + 22, box["y"] + 22)
        page.mouse.down()
        page.mouse.move(box["x"] + 82, box["y"] + 82, steps=5)
        page.mouse.up()
        assert page.inner_text(".hint") != hint
        page.click("text=Undo")
        assert page.inner_text(".hint") == hint


def test_a_zone_stays_a_zone_when_the_outline_loses_its_corners(browser):
    """Another page that loads the plan must not take the no-fly zone for the area to fly over."""
    outline = [[8.544, 47.397], [8.547, 47.397], [8.547, 47.399], [8.544, 47.397]]
    zone = [[8.5450, 47.3975], [8.5460, 47.3975], [8.5460, 47.3980], [8.5450, 47.3980], [8.5450, 47.3975]]
    plan = {"settings": {}, "plan": None, "vehicles": {}}
    with standing(vehicle(1)) as station:
        station.gets["/api/plan"] = plan | {"area": {"type": "Polygon", "coordinates": [outline, zone]}, "version": 3}
        station.answer = lambda method, path, body: (200, {"version": 4})
        with opened(browser, station.url) as page:
            planning(page)
            page.wait_for_function("document.querySelectorAll('.handle:not(.middle)').length === 7")
            page.locator(".handle:not(.middle)").first.focus()
            page.keyboard.press("Delete")
            page.wait_for_function("document.querySelectorAll('.handle:not(.middle)').length === 6")
            end = time.monotonic() + 60.0
            while not station.heard and time.monotonic() < end:
                page.wait_for_timeout(100)
            saved = station.heard[-1][2]["area"]
            assert [len(ring) for ring in saved["coordinates"]] == [3, 5]
        station.gets["/api/plan"] = plan | {"area": saved, "version": 4}
        with opened(browser, station.url) as page:
            planning(page)
            page.wait_for_function("document.querySelectorAll('.handle:not(.middle)').length === 6")
            page.click("text=Make plan")
            page.wait_for_selector(".notice:has-text('corner')")


def test_an_outline_that_crosses_itself_says_what_to_change(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        planning(page)
        draw(page, (600, 250), (900, 550), (900, 250), (600, 550))
        assert "crosses itself: drag a corner" in page.inner_text(".hint")
        page.click("text=Make plan")
        page.wait_for_selector(".notice:has-text('crosses itself')")
        assert [path for _, path, _ in station.heard if path == "/api/plans"] == []


def test_files_bring_an_area_or_say_what_is_wrong(browser):
    square = [[8.544, 47.397], [8.547, 47.397], [8.547, 47.399], [8.544, 47.397]]
    good = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [square]}}
    wrong = {"type": "Polygon", "coordinates": [[[x * 1e5, y] for x, y in square]]}
    files = [("a.geojson", json.dumps(good), 3, "ha"), ("b.kml", KML, 7, "ha"), ("c.json", "{", 7, "not valid JSON"),
             ("d.geojson", json.dumps(wrong), 7, "longitude and latitude in degrees"),
             ("e.geojson", "{}", 7, "no GeoJSON")]  # fmt: skip

    def answer(method, path, body):
        """The daemon's own reader."""
        name = path.partition("name=")[2]
        try:
            return 200, area_of(body if isinstance(body, bytes) else json.dumps(body).encode(), name)
        except InputError as error:
            return 422, {"detail": str(error)}

    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        station.answer = answer
        planning(page)
        for name, text, count, words in files:
            file = {"name": name, "mimeType": "text/plain", "buffer": text.encode()}
            page.set_input_files("input[type=file]", files=[file])
            page.wait_for_selector(f".notice:has-text('{name}')")
            assert words in page.inner_text(f".notice:has-text('{name}')")
            assert corners(page) == count


def made_plan(number="plan-1"):
    part = {"id": "v1", "length_m": 900.0, "time_s": 312, "photos": 40, "sorties": 1, "flights": [{"start_s": 0}]}
    return {"id": number, "covered_share": 1.0, "makespan_s": 312, "spacing_m": 20, "vehicles": [part]}


SURVEY = {"polygon": [[47.397, 8.544], [47.397, 8.547], [47.399, 8.547]], "angle": 30, "type": "ComplexItem",
          "TransectStyleComplexItem": {"CameraCalc": {
              "DistanceToSurface": 55, "DistanceMode": 1, "FocalLength": 16, "SensorWidth": 23.5, "ImageWidth": 6000,
              "ImageHeight": 4000, "SideOverlap": 65, "FrontalOverlap": 75, "CameraName": "A"}}}  # fmt: skip


@pytest.mark.slow
def test_a_survey_fills_the_fields_and_a_plan_is_had_for_a_drones_own_app(browser):
    document = {"fileType": "Plan", "mission": {"items": [SURVEY]}}

    def answer(method, path, body):
        return (200, area_of(json.dumps(body).encode(), "s.plan")) if "/areas" in path else (201, made_plan())

    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        station.answer = answer
        planning(page)
        file = {"name": "s.plan", "mimeType": "text/plain", "buffer": json.dumps(document).encode()}
        page.set_input_files("input[type=file]", files=[file])
        page.wait_for_selector(".notice:has-text('lines at 30 degrees')")
        shown = {key: page.input_value(f"[name={key}]") for key in ("altitude_m", "fov_min_deg")}
        assert shown == {"altitude_m": "55", "fov_min_deg": "72.5"}
        page.click("text=Overlap")
        assert page.input_value("[name=side_overlap]") == "65" and page.input_value("[name=forward_overlap]") == "75"
        page.click("text=Make plan")
        page.wait_for_selector("text=Missions for a DJI drone")
        page.select_option(".plan-result label.field select", "m3e")
        page.evaluate("document.querySelector('.plan-result a').addEventListener('click', (e) => e.preventDefault())")
        page.click(".plan-result button:text-is('Download')")
        assert "/api/plans/plan-1/files/m3e" in page.get_attribute(".plan-result a", "href")


@pytest.mark.slow
def test_a_zone_that_is_drawn_after_the_plan_stops_its_upload_and_start(browser):
    older = "The plan is older than the drawing: make the plan again"

    def answer(method, path, body):
        if path == "/api/plan":
            shared.update(body, version=shared["version"] + 1)
            return 200, {"version": shared["version"]}
        return (201, made_plan()) if path == "/api/plans" else (200, {"checks": []})

    shared = {"area": None, "settings": {}, "plan": None, "vehicles": {}, "version": 1}
    with standing(vehicle(7)) as station:
        station.gets |= {"/api/plan": shared, "/api/plans": [made_plan()], "/api/plans/plan-1/map": {"features": []}}
        station.answer = answer
        with opened(browser, station.url) as page:
            planning(page)
            draw(page, (600, 250), (900, 250), (900, 550), (600, 550))
            page.fill("[name=vehicles]", "1")
            page.click("text=Make plan")
            page.wait_for_selector(".plan-result")
            page.wait_for_function("() => document.querySelector('.assignments select')")
            page.select_option(".assignments select", "v7")
            assert page.inner_text(".plan-result .wrong") == ""
            draw(page, (700, 350), (800, 350), (750, 450), what="Add no-fly zone")
            page.wait_for_selector(f".plan-result .wrong:has-text('{older}')")
            refused(page, older)
            saved(page)
            with opened(browser, station.url) as second:  # a second page, or this one after a reload
                second.click("#tab-plan")
                second.wait_for_selector(f".plan-result .wrong:has-text('{older}')")
            page.click("text=Undo")
            page.click("text=Undo")
            page.wait_for_function("() => document.querySelector('.plan-result .wrong').textContent === ''")
            page.click("text=Check and start")
            page.wait_for_selector("dialog[open]")
            assert station.commands("upload") == []
            # drawn on another page while the dialog is open
            page.evaluate("import('/static/plan/area.js').then((a) => a.change((r) => r[0].push([8.5457, 47.398])))")
            page.wait_for_timeout(300)
            page.evaluate("document.querySelector('.preflight .primary').disabled = false")
            page.click(".preflight .primary")
            page.wait_for_selector(f".preflight >> text={older}")
            assert station.commands("start") == []


@pytest.mark.slow
def test_an_area_file_keeps_the_zones_that_were_drawn_and_says_so(browser):
    ring = [[8.544, 47.397], [8.547, 47.397], [8.547, 47.399], [8.544, 47.397]]
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        station.answer = lambda *_: (200, {"polygons": [[ring]], "lines": [], "no_fly": []})
        planning(page)
        draw(page, (600, 250), (900, 250), (900, 550), (600, 550))
        draw(page, (700, 350), (800, 350), (750, 450), what="Add no-fly zone")
        file = {"name": "b.geojson", "mimeType": "text/plain", "buffer": b"{}"}
        page.set_input_files("input[type=file]", files=[file])
        page.wait_for_selector(".notice:has-text('1 no-fly zone drawn before is kept')")
        page.evaluate(HERE)
        rings = page.evaluate("import('/static/plan/area.js').then((a) => a.area.rings.map((r) => r.length))")
        assert rings == [3, 3]


def test_the_height_counts_from_takeoff_unless_there_is_a_height_model(browser):
    shared = {"area": None, "settings": {}, "plan": None, "vehicles": {}, "version": 1}
    for dem, words in ((None, "Height above takeoff, m"), ("hills.tif", "Height above ground, m")):
        with standing(vehicle(1)) as station:
            station.gets["/api/plan"] = shared | {"dem": dem}
            with opened(browser, station.url) as page:
                page.click("#tab-plan")
                page.wait_for_selector(f"label:has-text('{words}')")


def test_a_field_out_of_range_names_its_range(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        planning(page)
        draw(page, (600, 250), (900, 250), (900, 550))
        page.fill("[name=altitude_m]", "5000")
        page.click("text=Make plan")
        page.wait_for_selector(".notice:has-text('give a number from 5 to 1000')")


def test_units_and_coordinates_are_the_persons(browser):
    with standing(vehicle(1, height_m=100.0)) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile")
        page.click(".tile")
        page.click("button[aria-label=Settings]")
        page.select_option(".settings select >> nth=1", "us")
        page.select_option(".settings select >> nth=2", "mgrs")
        page.click(".settings >> text=Close")
        page.wait_for_selector(".tile:has-text('328 ft')")
        page.wait_for_selector(".details:has-text('32T MT 65741 49460')")
        planning(page)
        assert "262" in page.input_value("[name=altitude_m]")


def test_a_plan_that_somebody_else_changed_meanwhile_is_theirs(browser):
    """GIVEN a plan of version 3 WHEN this page saves a change and the station has version 4 THEN that one is shown."""
    outline = {"type": "Polygon", "coordinates": [[[8.544, 47.397], [8.547, 47.397], [8.547, 47.399], [8.544, 47.397]]]}
    theirs = {"area": outline, "settings": {"altitude_m": 120}, "plan": None, "vehicles": {}, "version": 4}
    with standing(vehicle(1)) as station:
        drawn = []

        def answer(method, path, body):
            if not drawn:  # what is being drawn would stay
                return 200, {"version": 3}
            station.gets["/api/plan"] = theirs
            return 409, {"detail": "the plan was changed elsewhere (version 4); load it and change it again"}

        station.gets["/api/plan"] = theirs | {"area": None, "settings": {"altitude_m": 60}, "version": 3}
        station.answer = answer
        with opened(browser, station.url) as page:
            planning(page)
            page.wait_for_function("document.querySelector('[name=altitude_m]').value === '60'")
            draw(page, (600, 250), (900, 250), (900, 550), (600, 550))
            saved(page)
            drawn.append(True)
            page.fill("[name=altitude_m]", "70")
            page.press("[name=altitude_m]", "Tab")
            page.wait_for_selector(".notice:has-text('changed elsewhere')")
            page.wait_for_function("document.querySelector('[name=altitude_m]').value === '120'")
            assert {body["version"] for _, path, body in station.heard if path == "/api/plan"} == {3}
            assert corners(page) == 3


def opened_groups(page):
    for summary in page.locator(".panel form summary").all():
        summary.click()


@pytest.mark.slow
def test_wind_wait_and_terrain_go_into_the_request_and_contradictions_are_said(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        station.gets["/api/plan"] = {"version": 1, "dem": "hills.tif", "settings": {"relief": "level"}}
        station.answer = lambda *_: (422, {"detail": "30 m above ground are too few; give a larger --altitude"})
        page.reload()
        page.wait_for_function("() => window.orthoswarm")
        planning(page)
        draw(page, (600, 250), (900, 250), (900, 550))
        opened_groups(page)
        page.wait_for_function("document.querySelector('[name=relief]').value === 'level'")
        for name, text in (("wind_m_s", "8"), ("wait_min", "4"), ("height_tolerance_m", "12")):
            page.fill(f"[name={name}]", text)
        page.select_option("[name=end]", "hover")
        page.check("[name=terrain_items]")
        page.click("text=Make plan")
        page.wait_for_selector(".notice:has-text('say where the wind comes from')")
        page.fill("[name=wind_from_deg]", "270")
        page.click("text=Make plan")
        page.wait_for_selector(".notice:has-text('hovers at the end needs no wait')")
        page.select_option("[name=end]", "land")
        page.click("text=Make plan")
        page.wait_for_selector(".notice:has-text('give a larger \"Height above ground, m\"')")
        (body,) = [body for method, path, body in station.heard if method == "POST" and path == "/api/plans"]
        assert {
            "wind_m_s": 8, "wind_from_deg": 270, "wait_min": 4, "relief": "level", "height_tolerance_m": 12,
            "terrain_items": True, "end": "land",
        }.items() <= body.items()  # fmt: skip
        assert len(body["starts"]) == 1
        saved(page)  # kept for other pages a moment after the last change
        kept = [body["settings"] for method, path, body in station.heard if (method, path) == ("PUT", "/api/plan")][-1]
        assert (kept["wind_from_deg"], kept["terrain_items"], kept["relief"]) == ("270", True, "level")


def test_without_a_height_model_the_page_says_how_to_get_one(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        planning(page)
        draw(page, (600, 250), (900, 250), (900, 550))
        opened_groups(page)
        page.wait_for_selector("text=To follow the ground, start it with one")
        assert not page.is_visible("[name=relief]")
        page.click("text=Make plan")
        page.wait_for_selector(".notice")
        (body,) = [body for method, path, body in station.heard if method == "POST" and path == "/api/plans"]
        assert not {"relief", "terrain_items", "wind_m_s", "wait_min"} & body.keys()
