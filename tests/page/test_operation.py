"""A whole operation on the page of the real daemon with simulated vehicles, from an area's file to the offline pack."""

import contextlib
import json
import re
import zipfile

import pytest

from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.page_kit import DESK, PHONE, TABLET, opened, poll
from tests.kit.servers.ports import free_port
from tests.kit.vehicles.sim_cameras import Cameras, square
from tests.page.test_command_bar import confirm
from tests.vehicles.autopilots.test_fleet_scenarios import charge
from tests.vehicles.autopilots.test_twin_camera import ADDRESSES, CameraProcess, small_area

playwright = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")
REFINED = "async () => (await (await fetch('/api/completions')).json()).filter((row) => 'version' in row).length"
IDLE = "async () => (await (await fetch('/api/jobs')).json()).every((job) => !/queued|running/.test(job.state))"
LATE_MS = 15_000  # the daemon refines what a vehicle takes after its mission once it has been silent for 8 s
WORDS = "[...document.querySelectorAll('.tile .word')].map((e) => e.textContent)"


def accessible(page):
    report = axe.Axe().run(page)
    assert report.violations_count == 0, report.generate_report()


def until(page, count, condition):
    """Wait until a condition holds on the words of all tiles."""
    try:
        page.wait_for_function(
            f"() => {{ const w = {WORDS}; return w.length === {count} && w.every((t) => {condition}); }}"
        )
    except playwright.TimeoutError:
        pytest.fail(f"not {condition}: {page.evaluate(WORDS)}, {page.locator('.outcomes li').all_inner_texts()}")


COUNT_DONE = """() => {
  window.done = 0;
  const count = (row) => { if (row.dataset?.outcome === "done") window.done += 1; };
  const seen = (change) => change.type === "attributes" ? count(change.target) : change.addedNodes.forEach(count);
  const list = document.querySelector(".outcomes");
  new MutationObserver((changes) => changes.forEach(seen))
    .observe(list, { subtree: true, childList: true, attributeFilter: ["data-outcome"] });
}"""


def ended_done(page, count):
    """All vehicles have acknowledged, counted by `COUNT_DONE`: it goes by itself after 12 s, however busy we are."""
    page.wait_for_function(f"() => window.done >= {count}")
    page.evaluate("window.done = 0")
    with contextlib.suppress(playwright.TimeoutError):
        page.click("footer >> text=Dismiss", timeout=5_000)
    page.wait_for_selector(".command-log", state="hidden")


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
                page.set_default_timeout(300_000)
                operate(page, tmp_path, square(260), vehicles=2, altitude_m=60, fov_deg=65)
            cameras.over = True


@pytest.mark.sitl
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("address", ADDRESSES or ["no address in ORTHOSWARM_SITL"])
@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_a_real_autopilot_from_an_area_to_the_pack(browser, tmp_path, address, size):
    """The same under a real autopilot that carries the twin's camera; see test_twin_camera."""
    if not ADDRESSES:
        pytest.skip("ORTHOSWARM_SITL names no autopilot")
    charge(address)
    relay, stream, twin = free_port(), free_port(), tmp_path / "twin"
    with contextlib.ExitStack() as opened_here:
        camera = CameraProcess(
            "--link", address, "--relay", f"tcpin:127.0.0.1:{relay}", "--stream", f"tcp://127.0.0.1:{stream}",
            "--set", str(twin), "--rate", "1",
        )  # fmt: skip
        opened_here.callback(camera.close)
        camera.wait_for("map: ")
        source = camera.wait_for(r"camera of (v\d+) \(\w+\): --source (v\d+=\S+)")[2]
        arguments = ["--link", f"tcp:127.0.0.1:{relay}", "--source", source]
        arguments += ["--basemap", str(twin / "basemap.tif"), "--fov-min", "75"]
        served = opened_here.enter_context(serving(tmp_path / "flood", *arguments))
        rows = served.until("/api/vehicles", lambda rows: any(map(has_position, rows)))
        row = next(filter(has_position, rows))
        page = opened_here.enter_context(opened(browser, f"{served.url}/#token={served.token}", size, fake=False))
        page.set_default_timeout(600_000)
        area = small_area(row["lat_deg"], row["lon_deg"])
        operate(page, tmp_path, area, vehicles=1, altitude_m=60, fov_deg=75, way_home=True)


def has_position(row):
    return bool(row.get("lat_deg")) and (row.get("gps_fix") or 0) >= 3


def operate(page, folder, area, *, vehicles, altitude_m, fov_deg, way_home=False):
    """Plan, check, fly, pause, resume, complete, mark a find, take the pack; leaves a picture of each in the folder.

    `way_home`: pictures of it come after the mission is complete, and the pack waits for them, too.
    """
    page.evaluate(COUNT_DONE)
    page.click("#tab-plan")
    file = {"name": "area.geojson", "mimeType": "application/json", "buffer": json.dumps(area).encode()}
    page.set_input_files("input[type=file]", files=[file])
    page.wait_for_selector(".notice:has-text('area.geojson')")
    for name, value in (("vehicles", vehicles), ("altitude_m", altitude_m), ("fov_min_deg", fov_deg)):
        page.fill(f"[name={name}]", str(value))
    page.click("text=Make plan")
    page.wait_for_selector(".plan-result:not([hidden])")
    page.screenshot(path=folder / "1-plan.png")
    page.click("text=Upload missions")
    ended_done(page, vehicles)
    page.click("text=Check and start")
    page.wait_for_selector(f".checks section >> nth={vehicles - 1}")
    accessible(page)
    page.wait_for_function("() => !document.querySelector('.preflight .primary').disabled")
    page.screenshot(path=folder / "2-preflight.png")
    page.click(".preflight .primary")
    page.wait_for_selector(".preflight", state="hidden")

    page.click("#tab-fly")
    until(page, vehicles, "t.startsWith('on mission')")
    page.screenshot(path=folder / "3-on-mission.png")
    page.click(".command[data-verb=pause]")
    confirm(page)
    until(page, vehicles, "t.startsWith('paused')")
    page.screenshot(path=folder / "4-paused.png")
    ended_done(page, vehicles)
    accessible(page)
    page.click(".command[data-verb=resume]")
    confirm(page)
    ended_done(page, vehicles)
    until(page, vehicles, "t === 'complete' || t === 'on ground' || t === 'returning' || t === 'landing'")

    page.screenshot(path=folder / "5-flown.png")
    page.click("#tab-map")
    page.click("text=Show all")
    page.fill("input[aria-label='Note of the marker']", "Collapsed roof")
    page.click("text=Mark on the map")
    box = page.locator("#stage").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector(".finds li:has-text('Collapsed roof')")
    page.click(".finds >> text=Pictures")
    page.wait_for_function("() => [...document.querySelectorAll('.pictures img')].some((i) => i.naturalWidth > 0)")
    page.screenshot(path=folder / "6-find.png")
    accessible(page)
    page.click(".find-pictures button[aria-label=Close]")
    poll(page, lambda: page.evaluate(REFINED) == vehicles, 600.0)
    if way_home:
        page.click("#tab-fly")
        until(page, vehicles, "t === 'complete' || t === 'on ground'")
        page.wait_for_timeout(LATE_MS)
        poll(page, lambda: page.evaluate(IDLE), 600.0)
        page.click("#tab-map")
    page.click("#panel-map form button:text-is('Export')")
    link = page.locator(".files a:has-text('map.zip')")
    link.wait_for(timeout=240_000)
    page.screenshot(path=folder / "7-pack.png")
    with page.expect_download() as download:
        link.click()
    download.value.save_as(folder / "pack.zip")
    with zipfile.ZipFile(folder / "pack.zip") as archive:
        names = archive.namelist()
        page_html = archive.read("flood-map/index.html").decode()
    assert "Not refined" not in page_html
    assert "flood-map/orthoimage.tif" in names and "flood-map/orthoimage.kmz" in names
    assert re.search(r'"finds": \[\{"name": "Collapsed roof"', page_html)
