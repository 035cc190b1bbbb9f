"""The list of gaps: a press goes there; flying them plans first, and uploads only what was confirmed."""

from tests.kit.page_kit import opened, send, standing, vehicle
from tests.page.test_operation import accessible

RING = [[8.560, 47.400], [8.561, 47.400], [8.561, 47.401], [8.560, 47.401], [8.560, 47.400]]
SHARES = {"seen_share": 0.9, "poor_share": 0.04, "missed_share": 0.05, "planned_share": 0.01}
COVERAGE = {
    "state": "in flight", "version": 3, "plan": "plan-0", **SHARES, "recorded": SHARES,
    "pictures": {"placed": 60, "recorded": 12},
    "offers": [{"vehicle": "v2", "legs": 3, "length_m": 900.0}], "warnings": [],
    "gaps": [
        {"area_m2": 3200.0, "cause": "not triggered", "detail": "", "confidence": 0.95, "vehicle": "v1",
         "lat_deg": 47.4005, "lon_deg": 8.5605, "polygon": {"type": "Polygon", "coordinates": [RING]}},
    ],
    "missing_pictures": [
        {"vehicle": "v1", "image": f"event {k}", "after": "a.jpg", "cause": "pictures not arrived", "confidence": 0.95}
        for k in (7, 8)
    ],
}  # fmt: skip
PLAN = {
    "id": "plan-1", "names": {"v1": "v1"}, "warnings": ["a warning of the plan"],
    "vehicles": [{"id": "v1", "length_m": 400.0, "time_s": 90.0, "photos": 20, "sorties": 1, "flights": [{}]}],
}  # fmt: skip


def _answer(method, path, body):
    if path == "/api/coverage/flight":
        return 201, PLAN
    if path.endswith("/upload"):
        return 200, {"id": body["id"], "vehicle": "v1", "command": "upload", "outcome": "done", "reason": ""}
    return 200, {"checks": []}


def _posts(station) -> list[str]:
    return [path for method, path, _ in station.heard if method == "POST"]


def test_gaps_are_listed_and_flown_only_after_a_confirmation(browser):
    with standing(vehicle(1, armed=False)) as station:
        station.gets |= {
            "/api/coverage": COVERAGE, "/api/plans/plan-1/map": {"features": []},
            "/api/coverage/vehicles": [
                {"id": "v1", "battery": None, "minutes": None, "busy": ""},
                {"id": "v2", "battery": 0.7, "minutes": 9.0, "busy": "it is still flying; bring it home first"},
            ],
        }  # fmt: skip
        station.answer = _answer
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            words = page.locator(".coverage")
            page.wait_for_function("document.querySelector('.gaps button')?.textContent.includes('not triggered')")
            assert "90.0 %" in words.inner_text() and "3 lines" in words.inner_text()
            assert "2 pictures not arrived (the first: event 7)" in words.inner_text()
            page.locator(".gaps button").click()
            page.wait_for_function("Math.abs(orthoswarm.map.getCenter().lng - 8.5605) < 1e-3")
            page.click("text=Fly the gaps…")
            page.wait_for_selector(".gap-vehicles li >> nth=1")
            assert page.locator(".gap-vehicles input[type=checkbox]").nth(1).is_disabled()
            page.click("dialog[open] button:text-is('Plan')")
            page.wait_for_selector("dialog[open] >> text=Enter how many minutes")
            assert _posts(station) == []
            page.locator(".gap-vehicles input[inputmode=decimal]").fill("12")
            page.click("dialog[open] button:text-is('Plan')")
            page.wait_for_selector("text=a warning of the plan")
            assert _posts(station) == ["/api/coverage/flight"]
            assert station.heard[-1][2] == {"vehicles": {"v1": 12}}
            page.click("text=Upload, then check and start…")
            page.wait_for_selector("#preflight-title >> visible=true")
            assert _posts(station)[1].endswith("/v1/upload") and not any(p.endswith("/start") for p in _posts(station))


def test_a_vehicle_in_the_air_is_ticked_by_hand_and_paused_before_it_gets_another_mission(browser):
    with standing(vehicle(1, armed=True)) as station:
        row = {"id": "v1", "battery": 0.8, "minutes": 9.0, "busy": "it is still flying", "in_air": True}
        station.gets |= {
            "/api/coverage": COVERAGE, "/api/plans/plan-1/map": {"features": []}, "/api/coverage/vehicles": [row],
        }  # fmt: skip

        def answer(method, path, body):
            if path.endswith("/pause"):
                return 200, {"id": body["id"], "vehicle": "v1", "command": "pause", "outcome": "done", "reason": ""}
            return _answer(method, path, body)

        station.answer = answer
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            page.wait_for_function("document.querySelector('.gaps button')?.textContent.includes('not triggered')")
            page.click("text=Fly the gaps…")
            box = page.locator(".gap-vehicles input[type=checkbox]")
            box.wait_for()
            assert box.is_enabled() and not box.is_checked()
            box.check()
            page.click("dialog[open] button:text-is('Plan')")
            page.wait_for_selector("text=it is paused before it gets the new mission")
            assert station.heard[-1][2] == {"vehicles": {"v1": 9}, "in_air": ["v1"]}
            page.click("text=Upload, then check and start…")
            page.wait_for_selector("#preflight-title >> visible=true")
            assert [path.rsplit("/", 1)[-1] for path in _posts(station)][1:3] == ["pause", "upload"]


def test_pictures_asked_from_a_vehicle_are_listed_by_number_with_what_became_of_them(browser):
    rows = [
        {"vehicle": "v1", "number": 7, "state": "arrived", "reason": "", "percent": 100, "image": "IMG_0007.JPG"},
        {"vehicle": "v1", "number": 8, "state": "asked", "reason": "", "percent": 40, "image": "IMG_0008.JPG"},
        {"vehicle": "v1", "number": 9, "state": "waiting", "reason": "", "percent": 0, "image": ""},
        {"vehicle": "v1", "number": 10, "state": "refused", "reason": "it has no picture file with number 10",
         "percent": 0, "image": ""},
    ]  # fmt: skip
    with standing(vehicle(1, armed=False)) as station:
        station.gets["/api/coverage"] = COVERAGE | {"requests": rows}
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            summary = page.locator(".requests summary")
            summary.wait_for()
            assert "4 pictures asked from the vehicle, 1 arrived, 2 still to come, 1 refused" in summary.inner_text()
            summary.click()
            lines = page.locator(".requests details li").all_inner_texts()
            assert lines == [
                "Picture 7: arrived", "Picture 8: being read, 40 %", "Picture 9: waits for its turn",
                "Picture 10: refused, it has no picture file with number 10",
            ]  # fmt: skip
            accessible(page)
            station.gets["/api/coverage"] = COVERAGE | {"requests": [rows[0], rows[1] | {"state": "arrived"}]}
            send(page, {"type": "requests"})
            page.wait_for_function("document.querySelector('.requests summary').textContent.includes('2 arrived')")
            assert page.locator(".requests details").get_attribute("open") is not None  # it stays unfolded
