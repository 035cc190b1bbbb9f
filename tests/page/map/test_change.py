"""What changed since the basemap: the layer, its list that begins with the largest, and before and after at a press."""

from tests.kit.page_kit import opened, poll, send, standing, vehicle
from tests.page.test_operation import accessible
from tests.page.test_shown_truly import visible

WEST, SOUTH, EAST, NORTH = 8.54, 47.39, 8.56, 47.41


def row(area, probability, kind, at):
    return {
        "area_m2": area, "probability": probability, "kind": kind, "lat_deg": 47.4, "lon_deg": at,
        "bounds": [at - 1e-4, 47.3999, at + 1e-4, 47.4001], "photos": [{"vehicle": "v1", "image": f"{kind}.jpg"}],
    }  # fmt: skip


CHANGE = {
    "version": 5, "changed_share": 0.034, "not_visible_share": 0.1,
    "objects": [row(5200.0, 0.97, "water", 8.545), row(120.0, 0.6, "building gone or roof damaged", 8.555)],
    "corners": [[WEST, NORTH], [EAST, NORTH], [EAST, SOUTH], [WEST, SOUTH]],
}  # fmt: skip


def test_what_changed_is_listed_shown_and_swiped(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        page.click("#tab-map")
        page.wait_for_selector("section.change:has-text('Known once a vehicle is refined')")
        station.gets["/api/change"] = CHANGE
        send(page, {"type": "job", "id": 9, "kind": "change", "state": "done", "progress": 1, "message": ""})
        page.wait_for_selector("section.change li button >> nth=1")
        lines = page.locator("section.change li button").all_inner_texts()
        assert "water" in lines[0] and "97" in lines[0] and "building gone" in lines[1]
        assert "3.4" in page.inner_text("section.change")
        page.wait_for_function("orthoswarm.map.getLayer('change')")
        poll(page, lambda: visible(page, "change"))
        page.locator("section.change li button").nth(0).click()
        page.wait_for_function("Math.abs(orthoswarm.map.getCenter().lng - 8.545) < 1e-3")
        assert page.locator("#swipe-on").is_checked() and page.locator("#divider").is_visible()
        page.fill("[name=change-from]", "80")  # fewer false alarms
        page.wait_for_function("document.querySelectorAll('section.change .changes li').length === 1")
        page.uncheck("#panel-map [name=shown-change]")
        poll(page, lambda: not visible(page, "change"))
        accessible(page)
