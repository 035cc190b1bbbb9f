"""axe-core finds nothing on any mode, in both themes; what is pressed is at least 44 px large."""

import pytest

from orthoswarm.coverage.coverage_files import COLOURS as COLOURS_OF_CELLS
from orthoswarm.coverage.coverage_grid import CellState
from tests.kit.looks.colour_vision import least_difference, rgb_of
from tests.kit.page_kit import DESK, PHONE, TABLET, ok_for_all, opened, standing, vehicle

axe = pytest.importorskip("axe_playwright_python.sync_playwright")
SMALL = """() => [...document.querySelectorAll("button, select, summary, input:not([type=checkbox])")]
  .filter((e) => e.checkVisibility() && !e.closest(".maplibregl-ctrl-attrib") && !e.classList.contains("hidden-file"))
  .map((e) => [e.outerHTML.slice(0, 80), e.getBoundingClientRect()])
  .filter(([, box]) => box.height < 43.5 || box.width < 43.5).map(([html]) => html)"""


@pytest.mark.slow
@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.parametrize("theme", ["dark", "sunlight"])
def test_nothing_stands_in_the_way(browser, theme, size):
    rows = [vehicle(1, name="Falcon", battery=0.05), vehicle(2, silent_s=30), vehicle(3, battery=0.2)]
    with standing(*rows) as station, opened(browser, station.url, size) as page:
        ok_for_all(station, "refused", "the battery is empty")
        page.click("button[aria-label=Settings]")
        page.select_option(".settings select >> nth=0", theme)
        assert axe.Axe().run(page).violations_count == 0
        page.click(".settings >> text=Close")
        page.click(".tile:has-text('Falcon')")
        page.click(".details [data-verb=rtl]")
        page.wait_for_timeout(400)
        page.click(".confirm-yes")
        page.click(".command[data-verb=rtl]")
        for mode in ("fly", "plan", "map"):
            page.click(f"#tab-{mode}")
            report = axe.Axe().run(page)
            assert report.violations_count == 0, report.generate_report()
            assert page.evaluate(SMALL) == []


@pytest.mark.parametrize("dem", [None, "relief.tif"], ids=["no-dem", "dem"])
@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_every_field_of_a_plan_unfolded(browser, size, dem):
    with standing(vehicle(1, name="Falcon")) as station:
        station.gets["/api/plan"] = {
            "version": 1,
            "area": None,
            "settings": {},
            "plan": None,
            "vehicles": {},
            "dem": dem,
        }
        with opened(browser, station.url, size) as page:
            page.click("#tab-plan")
            for group in page.locator("#panel-plan details > summary").all():
                group.click()
            fields = ["wait_min", "wind_m_s", "wind_from_deg", "side_overlap"]
            fields += ["relief", "height_tolerance_m", "terrain_items"] if dem else []
            for name in fields:
                page.locator(f"[name={name}]").scroll_into_view_if_needed()
                assert page.locator(f"[name={name}]").is_visible(), name
            for theme in ("dark", "sunlight"):
                page.evaluate(f"document.documentElement.dataset.theme = '{theme}'")
                page.wait_for_timeout(300)
                report = axe.Axe().run(page)
                assert report.violations_count == 0, report.generate_report()
                assert page.evaluate(SMALL) == []
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


COLOURS = """import('/static/map/colours.js').then((m) => [
  [...Array(10).keys()].map((k) => m.colourOf(`other ${k}`)), Object.values(m.LEGS).map((leg) => leg.colour)])"""
SIGNS = """[...new Set(orthoswarm.map.queryRenderedFeatures({ layers: ["legs-signs"] }).map((f) => f.properties.state))]
  .sort().join()"""


def test_cells_of_the_coverage_are_told_apart_and_are_those_of_its_legend(browser):
    cells = [COLOURS_OF_CELLS[state][:3] for state in (CellState.SEEN, CellState.POOR, CellState.MISSED)]
    assert least_difference(cells) > 30  # it was 19
    read = """['seen', 'poor', 'missed'].map((state) => {
      const swatch = document.body.appendChild(document.createElement('i'));
      swatch.className = 'swatch';
      swatch.dataset.state = state;
      return getComputedStyle(swatch).backgroundColor; })"""
    with standing() as station, opened(browser, station.url) as page:
        assert page.evaluate(read) == [f"rgb{cell}" for cell in cells]


def test_a_vehicle_has_one_colour_on_all_pages(browser):
    """GIVEN pages that hear of vehicles in other orders THEN their tiles have the same colours, all different."""
    seen = []
    for order in ((1, 2, 3), (3, 1, 2)):
        with standing(*(vehicle(k) for k in order)) as station, opened(browser, station.url) as page:
            page.wait_for_selector(".tile >> nth=2")
            read = "[...document.querySelectorAll('.tiles li')].map((e) => [e.dataset.id, e.firstChild.style.cssText])"
            seen.append(sorted(page.evaluate(read)))
    assert seen[0] == seen[1] and len({colour for _, colour in seen[0]}) == 3


def test_legs_without_a_basemap_are_not_called_failed(browser):
    layer = {"name": "realtime", "version": 1, "empty": True, "bounds": None, "tiles": "/none", "maxzoom": 22}
    legs = {"type": "FeatureCollection", "features": [leg(0, "failed"), leg(1, "carried")]}
    for layers, words, shown in (
        ([layer], "This station has no basemap", ""),
        ([layer | {"name": "basemap"}, layer], "No line was found on the basemap", "carried,failed"),
    ):
        with standing() as station:
            station.gets |= {"/api/legs": legs, "/api/layers": layers}
            with opened(browser, station.url) as page:
                page.evaluate("orthoswarm.map.jumpTo({ center: [8.5456, 47.3977], zoom: 17 })")
                page.click("#tab-map")
                page.wait_for_selector(f"#panel-map:has-text('{words}')")
                page.check("#panel-map [name=shown-legs]")
                page.wait_for_function("orthoswarm.map.queryRenderedFeatures({ layers: ['legs-refined'] }).length > 1")
                page.wait_for_function(f"{SIGNS} === '{shown}'")
                assert page.locator("p.leg:visible").count() == (3 if shown else 0)


def test_a_vehicle_in_danger_has_a_sign_on_the_map(browser):
    rows = (vehicle(1, battery=0.05), vehicle(2, battery=0.2), vehicle(3))
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector("button.vehicle >> nth=2")
        page.wait_for_selector("button.vehicle[data-level=bad]")
        signs = """[...document.querySelectorAll('button.vehicle')].map((e) =>
          [e.dataset.level, getComputedStyle(e.querySelector('span'), '::before').content])"""
        assert sorted(page.evaluate(signs)) == [["bad", '"‼ "'], ["ok", "none"], ["warn", '"! "']]


def leg(number, state):
    line = [[8.5446 + 0.0008 * number, 47.3970], [8.5446 + 0.0008 * number, 47.3984]]
    about = {"vehicle": "v1", "sortie": 1, "leg": number, "stage": "fine", "state": state, "sigma_m": 0.5}
    return {"type": "Feature", "properties": about, "geometry": {"type": "LineString", "coordinates": line}}


def test_legs_and_vehicles_are_told_apart_without_seeing_all_colours(browser):
    states = ["carried", "failed", "matched"]
    with standing() as station:
        legs = [leg(number, state) for number, state in enumerate(states)]
        station.gets["/api/legs"] = {"type": "FeatureCollection", "features": legs}
        with opened(browser, station.url) as page:
            page.evaluate("orthoswarm.map.jumpTo({ center: [8.5456, 47.3977], zoom: 17 })")
            page.click("#tab-map")
            page.check("#panel-map [name=shown-legs]")
            page.wait_for_function(f"{SIGNS} === '{','.join(states)}'")  # a sign on each, not the colour alone
            titles = [row.inner_text() for row in page.locator("p.leg b").all()]
            assert [title.split()[0] for title in titles] == ["✓", "≈", "✕"]
            vehicles, of_legs = page.evaluate(COLOURS)
    assert least_difference([rgb_of(colour) for colour in vehicles]) > 15  # ten vehicles; it was 1
    assert least_difference([rgb_of(colour) for colour in of_legs]) > 30
