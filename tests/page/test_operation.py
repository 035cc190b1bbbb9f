"""A whole operation on the page of the real daemon with simulated vehicles, from an area's file to the offline pack."""

import json
import re
import zipfile

import pytest

from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.page_kit import DESK, PHONE, TABLET, opened
from tests.kit.sim_cameras import Cameras, square
from tests.page.test_commands import confirm

playwright = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")
WORDS = "[...document.querySelectorAll('.tile .word')].map((e) => e.textContent)"


def accessible(page):
    report = axe.Axe().run(page)
    assert report.violations_count == 0, report.generate_report()


def until(page, condition):
    """Wait until a condition holds on the words of all tiles."""
    try:
        page.wait_for_function(f"() => {{ const w = {WORDS}; return w.length === 2 && w.every((t) => {condition}); }}")
    except playwright.TimeoutError:
        pytest.fail(f"not {condition}: {page.evaluate(WORDS)}, {page.locator('.outcomes li').all_inner_texts()}")


def ended_done(page):
    """Both vehicles have acknowledged; the list is dismissed."""
    page.wait_for_function("() => document.querySelectorAll('[data-outcome=done]').length >= 2")
    page.click("footer >> text=Dismiss")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_from_an_area_to_the_pack(browser, tmp_path, size):
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    cameras = Cameras()
    vehicles = make_swarm(2, home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0), on_exposure=cameras.expose)
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=2.0) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(tmp_path / "flood", *links, "--fov-min", "65") as served:
            cameras.served = served
            served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
            with opened(browser, f"{served.url}/#token={served.token}", size, fake=False) as page:
                operate(page, tmp_path)
            cameras.over = True


def operate(page, folder):
    page.click("#tab-plan")
    file = {"name": "area.geojson", "mimeType": "application/json", "buffer": json.dumps(square(260)).encode()}
    page.set_input_files("input[type=file]", files=[file])
    page.wait_for_selector(".notice:has-text('area.geojson')")
    for name, value in (("vehicles", "2"), ("altitude_m", "60"), ("fov_min_deg", "65")):
        page.fill(f"[name={name}]", value)
    page.click("text=Make plan")
    page.wait_for_selector(".plan-result:not([hidden])")
    page.click("text=Upload missions")
    ended_done(page)
    page.click("text=Check and start")
    page.wait_for_selector(".checks section >> nth=1")
    accessible(page)
    page.wait_for_function("() => !document.querySelector('.preflight .primary').disabled")
    page.click(".preflight .primary")
    page.wait_for_selector(".preflight", state="hidden")

    page.click("#tab-fly")
    until(page, "t.startsWith('on mission')")
    page.click(".command[data-verb=pause]")
    confirm(page)
    until(page, "t.startsWith('paused')")
    ended_done(page)
    accessible(page)
    page.click(".command[data-verb=resume]")
    confirm(page)
    ended_done(page)
    until(page, "t === 'complete' || t === 'on ground' || t === 'returning' || t === 'landing'")

    page.click("#tab-map")
    page.click("text=Show all")
    page.fill("input[aria-label='Note of the find']", "Collapsed roof")
    page.click("text=Mark on the map")
    box = page.locator("#stage").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector(".finds li:has-text('Collapsed roof')")
    page.click(".finds >> text=Pictures")
    page.wait_for_function("() => [...document.querySelectorAll('.pictures img')].some((i) => i.naturalWidth > 0)")
    accessible(page)
    page.click(".find-pictures button[aria-label=Close]")
    page.click("#panel-map form button:text-is('Export')")
    link = page.locator(".files a:has-text('map.zip')")
    link.wait_for(timeout=240_000)
    with page.expect_download() as download:
        link.click()
    download.value.save_as(folder / "pack.zip")
    with zipfile.ZipFile(folder / "pack.zip") as archive:
        names = archive.namelist()
        page_html = archive.read("flood-map/index.html").decode()
    assert "flood-map/orthoimage.tif" in names or "flood-map/realtime.tif" in names
    assert re.search(r'"finds": \[\{"name": "Collapsed roof"', page_html)
