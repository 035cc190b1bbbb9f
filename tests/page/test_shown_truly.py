"""What the page shows is so: what vehicles hold, in the order of the layers, saved in the order of the edits."""

import threading

import pytest

from tests.kit.page_kit import PHONE, opened, poll, saved, send, standing, vehicle
from tests.page.test_tablet import EMPTY_PLAN, keep_plans

HELD = [[1, 8.545, 47.397], [2, 8.547, 47.397], [4, 8.547, 47.399], [5, 8.545, 47.399]]
ON_ITEM_4 = {"phase": "active", "item": 4, "items": 6}
PARTS = [{"id": i, "length_m": 9, "time_s": 9, "photos": 1, "sorties": 1, "flights": []} for i in ("v1", "v2")]
PLAN = {"id": "p1", "vehicles": PARTS, "covered_share": 1, "makespan_s": 9, "warnings": ["v1 waits for v2 at 30 m"]}
LINE = {"type": "LineString", "coordinates": [[8.5, 47.3], [8.6, 47.3]]}
DRAFT = {"features": [{"type": "Feature", "properties": {"vehicle": "v1", "kind": "leg"}, "geometry": LINE}]}
OUTLINE = [[8.544, 47.396], [8.547, 47.396], [8.547, 47.399], [8.544, 47.399], [8.544, 47.396]]
ZONE = [[8.545, 47.397], [8.5455, 47.397], [8.5455, 47.3975], [8.545, 47.397]]
BOUNDS = [8.54, 47.39, 8.56, 47.41]


def drawn(page, source):
    return page.evaluate(f"orthoswarm.map.getStyle().sources['{source}'].data.features")


def visible(page, layer):
    return page.evaluate(f"orthoswarm.map.getLayoutProperty('{layer}', 'visibility') !== 'none'")


def with_plan(station, **more):
    keep_plans(station)
    station.gets |= {"/api/plans": [PLAN], "/api/plans/p1/map": DRAFT}
    station.gets["/api/plan"] = EMPTY_PLAN | {"plan": "p1", "vehicles": {"v1": "v5", "v2": "v6"}} | more


def test_in_flight_the_map_shows_what_each_vehicle_holds_and_never_a_plan_that_nobody_flies(browser):
    with standing(vehicle(5, route=3, mission=ON_ITEM_4), vehicle(6, route=0)) as station:
        with_plan(station)
        station.gets["/api/routes"] = [{"vehicle": "v5", "route": 3, "points": HELD}]
        with opened(browser, station.url) as page:
            page.wait_for_selector(".tile >> nth=1")
            poll(page, lambda: drawn(page, "routes"))
            parts = {f["properties"]["part"]: f["geometry"]["coordinates"] for f in drawn(page, "routes")}
            here = [station.gets["/api/vehicles"][0][key] for key in ("lon_deg", "lat_deg")]
            assert parts == {"flown": [HELD[0][1:], HELD[1][1:], here], "left": [here, HELD[2][1:], HELD[3][1:]]}
            assert [f["geometry"]["coordinates"] for f in drawn(page, "waypoints")] == [HELD[2][1:]]
            poll(page, lambda: drawn(page, "plan"))
            assert visible(page, "routes-left") and not visible(page, "plan")
            page.click("#tab-plan")
            poll(page, lambda: visible(page, "plan"))  # a draft, in its own mode
            station.gets["/api/routes"] = [{"vehicle": "v5", "route": 4, "points": HELD[:2]}]
            send(page, {"type": "vehicle", "id": "v5", "system": 5, "route": 4, "mission": ON_ITEM_4 | {"item": 1}})
            poll(
                page,
                lambda: len(drawn(page, "routes")) == 1 and drawn(page, "routes")[0]["properties"]["part"] == "left",
            )
            send(page, {"type": "vehicle", "id": "v5", "system": 5, "route": 0})  # an upload has begun
            poll(page, lambda: not drawn(page, "routes"))


def test_layers_lie_in_one_order_whatever_comes_first(browser):
    coverage = {"state": "in flight", "version": 1, "seen_share": 0.9, "gaps": [], "missing_pictures": [], "plan": "p"}
    coverage |= {"recorded": {"seen_share": 0.9}, "pictures": {"placed": 1, "recorded": 1}}
    w, s, e, n = BOUNDS
    with standing(vehicle(1)) as station:
        station.gets["/api/coverage"] = coverage | {"corners": [[w, n], [e, n], [e, s], [w, s]]}
        with opened(browser, station.url) as page:
            page.wait_for_function("orthoswarm.map.getLayer('coverage')")
            rows = [{"name": name, "version": 1, "empty": False, "bounds": BOUNDS} for name in ("fine", "basemap")]
            station.gets["/api/layers"] = rows
            send(page, {"type": "layer"})
            page.wait_for_function("orthoswarm.map.getLayer('basemap')")
            order = page.evaluate("orthoswarm.map.getStyle().layers.map((layer) => layer.id)")
            wanted = ["ground", "basemap", "fine", "coverage", "footprints", "plan", "routes-left", "homes"]
            assert [layer for layer in order if layer in wanted] == wanted


def test_the_imagery_is_clean_in_map_until_an_overlay_is_switched_on(browser):
    overlays = ("area", "area-edge", "no-fly", "plan", "routes-left", "trails", "footprints", "legs", "fences")
    with standing(vehicle(1)) as station:
        with_plan(station, area={"type": "Polygon", "coordinates": [OUTLINE, ZONE]})
        with opened(browser, station.url) as page:
            assert not visible(page, "legs") and not visible(page, "area") and visible(page, "area-edge")
            page.click("#tab-map")
            poll(page, lambda: not any(visible(page, layer) for layer in overlays))
            page.click("#panel-map [name=shown-legs]")
            poll(page, lambda: visible(page, "legs-signs"))
            page.click("text=Overlays")
            page.click("#shown >> text=No-fly zones of the plan")
            poll(page, lambda: visible(page, "no-fly"))
            page.click("#tab-fly")
            poll(page, lambda: not visible(page, "legs-signs"))  # how well lines lie on the map is nothing for a pilot
            page.click("#tab-map")
            poll(page, lambda: visible(page, "legs-signs") and visible(page, "no-fly"))


def test_edits_are_saved_in_order_though_the_first_answer_is_slow(browser):
    with standing(vehicle(1)) as station:
        keep_plans(station)
        slow, keeps = threading.Event(), station.answer

        def answer(method, path, body):
            if path == "/api/plan" and body["version"] == 1:
                slow.wait(30.0)
            return keeps(method, path, body)

        station.answer = answer
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.wait_for_selector("[name=altitude_m]")
            for value in ("61", "62"):
                page.fill("[name=altitude_m]", value)
                page.press("[name=altitude_m]", "Tab")
                page.wait_for_timeout(1500)
            slow.set()
            saved(page)
            assert station.gets["/api/plan"]["settings"]["altitude_m"] == 62
            assert [body["version"] for _, path, body in station.heard if path == "/api/plan"] == [1, 2]
            assert page.locator(".notice").count() == 0


def test_what_two_pages_change_at_once_is_merged(browser):
    """GIVEN a change of the height WHEN another page has changed the speed and drawn a zone THEN all three are kept."""
    with standing(vehicle(1)) as station:
        keep_plans(station)
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.wait_for_selector("[name=altitude_m]")
            page.fill("[name=altitude_m]", "55")
            page.press("[name=altitude_m]", "Tab")
            saved(page)
            now = station.gets["/api/plan"]
            area = {"type": "Polygon", "coordinates": [OUTLINE, ZONE]}
            theirs = {"version": 90, "area": area, "settings": now["settings"] | {"speed_m_s": "7"}}
            station.gets["/api/plan"] = now | theirs  # without a word on the stream
            page.fill("[name=altitude_m]", "66")
            page.press("[name=altitude_m]", "Tab")
            poll(page, lambda: station.gets["/api/plan"]["version"] == 91)
            both = station.gets["/api/plan"]
            assert (both["settings"]["altitude_m"], both["settings"]["speed_m_s"]) == (66, "7")
            assert both["area"] == area
            page.wait_for_function("document.querySelector('[name=speed_m_s]').value === '7'")
            assert page.locator(".zones li").count() == 1 and page.locator(".notice").count() == 0


def test_routes_are_letters_and_vehicles_keep_their_names(browser):
    checks = [{"vehicle": v, "state": "ok", "items": [], "height_m": 50, "time_s": 9} for v in ("v5", "v6")]
    with standing(vehicle(5), vehicle(6)) as station:
        with_plan(station)
        keeps = station.answer
        station.answer = lambda method, path, body: (
            (200, {"checks": checks}) if path.endswith("/preflight") else keeps(method, path, body)
        )
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.wait_for_selector(".assignments li >> nth=1")
            assert page.locator(".assignments b").all_inner_texts() == ["Route A", "Route B"]
            assert page.inner_text(".plan-result .warnings") == "Route A waits for Route B at 30 m"
            page.click("text=Check and start…")
            page.wait_for_selector(".starts li:has-text('v5 flies Route A')")
            start = page.get_by_role("button", name="Start 2 vehicles").bounding_box()
            box = page.locator("dialog.preflight[open]").bounding_box()
            assert start["y"] + start["height"] <= box["y"] + box["height"]


def test_a_plan_that_is_older_than_the_drawing_is_pale_and_the_map_says_so(browser):
    with standing(vehicle(5), vehicle(6)) as station:
        area = {"type": "Polygon", "coordinates": [OUTLINE, ZONE]}
        with_plan(station, area=area, settings={"made_of": "another", "made_with": {}})
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.wait_for_selector(".map-note:has-text('older than the drawing')")
            poll(page, lambda: [f["properties"]["old"] for f in drawn(page, "plan")] == [True])


def test_zones_of_the_plan_are_offered_to_vehicles_that_do_not_hold_them(browser):
    held = {"zones": [{"kind": "exclusion", "ring": ZONE[:-1]}], "read_s": 1.0}
    with standing(vehicle(5, fence=held), vehicle(6, fence={"zones": [], "read_s": 1.0})) as station:
        with_plan(station, area={"type": "Polygon", "coordinates": [OUTLINE, ZONE]})
        keeps, done = station.answer, {"id": "x", "vehicle": "v6", "command": "fence", "outcome": "done", "reason": ""}
        station.answer = lambda method, path, body: (
            (200, done) if path.endswith("/fence") else keeps(method, path, body)
        )
        with opened(browser, station.url) as page:
            page.click("#tab-plan")
            page.wait_for_selector("text=The no-fly zones are not in the geofence of v6")
            page.click("text=Upload the zones to 1 geofence")
            page.wait_for_selector(".outcomes li:has-text('v6: Geofence')")
            assert [path for _, path, _ in station.heard if path.endswith("/fence")] == ["/api/missions/v6/fence"]
            page.click(".zones button:text-is('Delete')")
            page.wait_for_selector("text=Upload the zones", state="hidden")
            saved(page)
            assert len(station.gets["/api/plan"]["area"]["coordinates"]) == 1


def test_a_refinement_that_found_nothing_on_the_basemap_is_not_done_in_green(browser):
    job = {"id": 1, "kind": "refine", "vehicle": "v1", "sortie": 1, "state": "done", "progress": 1, "message": ""}
    leg = {"vehicle": "v1", "sortie": 1, "leg": 1, "stage": "fine", "state": "failed", "sigma_m": 2.0}
    with standing(vehicle(1)) as station:
        station.gets["/api/jobs"] = [job]
        station.gets["/api/legs"]["features"] = [{"type": "Feature", "properties": leg, "geometry": LINE}]
        station.gets["/api/layers"] = [{"name": "basemap", "version": 1, "empty": False, "bounds": BOUNDS}]
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            page.wait_for_selector(".jobs [data-state=unmatched]:has-text('not found on the basemap')")


@pytest.mark.parametrize("units", ["metric", "us"])
def test_what_the_station_says_is_in_the_units_of_the_person(browser, units):
    rows = vehicle(1, behind="is 12 s late, 100 m from v2 at 10 m/s (2.5 km)")
    with standing(rows) as station, opened(browser, station.url, PHONE) as page:
        page.evaluate(f"""import('/static/core/settings.js').then((m) => m.setSetting("units", "{units}"))""")
        words = "100 m from v2 at 10 m/s (2.5 km)" if units == "metric" else "328 ft from v2 at 22 mph (1.55 mi)"
        page.wait_for_selector(f".tile .why:has-text('{words}')")


def test_the_map_says_where_it_is_not_to_be_trusted_once_that_was_exported(browser):
    w, south, e, north = BOUNDS
    corners = [[w, north], [e, north], [e, south], [w, south]]
    trust = {"version": 7, "headline": "Places lie within 20 cm.", "corners": corners}
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.click("#tab-map")
        page.wait_for_selector("text=Known once a vehicle is refined")
        station.gets["/api/trust"] = trust
        send(page, {"type": "job", "id": 9, "kind": "export", "state": "done", "progress": 1, "message": ""})
        page.wait_for_selector("text=Places lie within 20 cm.")
        page.wait_for_function("orthoswarm.map.getLayer('trust')")
        assert not visible(page, "trust")
        page.check("#panel-map [name=shown-trust]")
        poll(page, lambda: visible(page, "trust"))


def test_a_pilot_sees_attitude_climb_and_gimbal_and_what_a_picture_will_show(browser):
    about = {"climb_m_s": -1.5, "roll_deg": 4, "pitch_deg": -7, "heading_deg": 90.0, "gimbal_pitch_deg": -30}
    with standing(vehicle(1, **about)) as station:
        keep_plans(station)
        with opened(browser, station.url) as page:
            page.click(".tile")
            page.wait_for_selector(".details:has-text('roll 4°, pitch -7°, heading 90°')")
            words = page.inner_text(".details")
            assert "sinks 1.5 m/s" in words and "-30° (-90 is down)" in words
            page.click("#tab-plan")
            page.fill("[name=altitude_m]", "100")
            page.fill("[name=fov_min_deg]", "90")
            page.wait_for_selector("text=A picture shows 200.0 m across; with 4000 pixels, 5.0 cm a pixel.")


@pytest.mark.parametrize(
    ("typed", "lon", "lat"),
    [
        ("47.3977, 8.5456", 8.5456, 47.3977),
        ("-33.8568 151.2153", 151.2153, -33.8568),
        ("47°23'51.7\"N 8°32'44.2\"E", 8.545611, 47.397694),
        ("S 33 51 24.5, E 151 12 55.1", None, None),  # no signs between degrees and minutes: it could mean anything
        ("32T 465711 E 5249461 N", 8.5456, 47.3977),
        ("32T MT 65711 49460", 8.5456, 47.3977),
        ("56H LH 34900 52288", 151.2153, -33.8568),
        ("nowhere", None, None),
    ],
)
def test_a_place_is_found_by_its_coordinates(browser, typed, lon, lat):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.click("#tab-map")
        page.fill("[name=go-to]", typed)
        page.press("[name=go-to]", "Enter")
        if lon is None:
            page.wait_for_selector("text=These are no coordinates")
        else:
            page.wait_for_function("orthoswarm.map.getZoom() >= 18")
            there = page.evaluate("orthoswarm.map.getCenter().toArray()")
            assert there == pytest.approx([lon, lat], abs=2e-5), there
