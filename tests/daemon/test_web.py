"""The web page in headless Chromium against the real daemon."""

import io
import shutil

import numpy as np
import pytest
from PIL import Image

from tests.kit.daemon_kit import line, serving

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if CHROMIUM is None:
    pytest.skip("no Chromium is installed", allow_module_level=True)

FLAGS = ["--no-sandbox", "--disable-gpu", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
FLAGS += ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"]
LIMIT_MS = 120_000


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser, tmp_path):
    with serving(tmp_path / "w") as served:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(LIMIT_MS)
        page.foreign, page.errors, page.tiles = [], [], []
        page.on("request", lambda r: page.tiles.append(r.url.split("/tiles/")[1]) if "/tiles/" in r.url else None)
        page.on(
            "request",
            lambda r: None if r.url.startswith((served.url, "blob:", "data:")) else page.foreign.append(r.url),
        )
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.goto(f"{served.url}/#token={served.token}")
        page.wait_for_selector("#link.on")
        yield served, page
        assert page.errors == []
        assert page.foreign == []  # it works without the internet
        page.close()


def colours(page) -> float:
    """Share of the map that is colourful."""
    shot = np.asarray(Image.open(io.BytesIO(page.locator("#map").screenshot())).convert("RGB"), float)
    return float((shot[:, :900].std(axis=2) > 20).mean())


def test_the_map_appears_as_pictures_come(page):
    served, page = page
    assert "None yet" in page.inner_text("#vehicles")
    before = colours(page)
    for shot in line(6, "falcon <b>"):
        served.send(shot)
    page.wait_for_selector(".card:has-text('falcon <b>')")  # a name is a text, not a piece of the page
    page.wait_for_selector("[data-layer=realtime]:not(.off)")
    for _ in range(60):
        if colours(page) > before + 0.004:
            break
        page.wait_for_timeout(500)
    assert colours(page) > before + 0.004
    shown = colours(page)
    levels = {int(tile.split("/")[1]) for tile in page.tiles}
    assert levels and min(levels) > 10  # the tiles of the whole world, which are empty, are not asked for first
    page.locator("[data-layer=realtime] input[type=checkbox]").uncheck()
    for _ in range(60):
        if colours(page) < shown - 0.004:
            break
        page.wait_for_timeout(500)
    assert colours(page) < shown - 0.004
    page.click("text=refine now")
    page.click("#confirm >> text=Yes")
    page.wait_for_selector("#jobs .bar.done")


def test_an_area_is_drawn_and_planned(page):
    _, page = page
    page.evaluate("orthoswarm.map.jumpTo({center: [103.2, 30.57], zoom: 16})")
    page.click("#draw")
    for x, y in ((300, 250), (600, 250), (600, 550), (300, 550)):
        page.mouse.click(x, y)
        page.wait_for_timeout(400)
    page.fill("[name=vehicles]", "2")
    page.click("#make")
    page.wait_for_selector("#plan-result >> text=covered in")
    assert page.locator("#plan-result .card").count() == 2
    page.click("text=Start all")
    page.wait_for_selector("#confirm[open]")
    page.click("#confirm >> text=Cancel")
    page.click("text=Upload all")
    page.click("#confirm >> text=Yes")
    page.wait_for_selector("#problem:not([hidden])")
    assert "links" in page.inner_text("#problem")
    page.wait_for_timeout(2500)  # what follows meanwhile does not take it away
    page.click("#dismiss")
    page.wait_for_selector("#problem", state="hidden")
    before_and_after_reach_as_far_as_the_panel(page)
    it_fits_a_tablet_held_upright(page)


def before_and_after_reach_as_far_as_the_panel(page):
    page.check("#swipe-on")
    slider, panel = page.locator("#swipe").bounding_box(), page.locator("#panel").bounding_box()
    assert 0 <= panel["x"] - (slider["x"] + slider["width"]) < 40
    for share in (0, 250, 1000):
        page.locator("#swipe").fill(str(share))
        line = page.locator("#divider").bounding_box()["x"]
        assert abs(line - slider["width"] * share / 1000) < 5
    page.uncheck("#swipe-on")
    page.wait_for_selector("#divider", state="hidden")


def it_fits_a_tablet_held_upright(page):
    page.set_viewport_size({"width": 600, "height": 900})
    panel, chart = page.locator("#panel").bounding_box(), page.locator("#map").bounding_box()
    assert panel["width"] == 600
    assert panel["y"] > 350
    assert chart["height"] > 400
    assert chart["y"] + chart["height"] <= panel["y"] + 1
    for button in page.locator("button:visible").all()[:6]:
        box = button.bounding_box()
        if box and box["y"] > panel["y"]:
            assert box["height"] >= 40
