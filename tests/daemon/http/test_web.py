"""The page in headless Chromium against the real daemon."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from tests.kit.daemon_kit import line, serving
from tests.kit.page_kit import CHROMIUM, FLAGS, TABLET, opened

playwright = pytest.importorskip("playwright.sync_api")
if CHROMIUM is None:
    pytest.skip("no Chromium is installed", allow_module_level=True)


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser, tmp_path):
    with serving(tmp_path / "w") as served, opened(browser, f"{served.url}/#token={served.token}", fake=False) as page:
        page.tiles = []
        page.on("request", lambda r: page.tiles.append(r.url.split("/tiles/")[1]) if "/tiles/" in r.url else None)
        page.wait_for_selector(".link[data-link=live]")
        yield served, page


def colours(page) -> float:
    """Share of the map that is colourful."""
    shot = np.asarray(Image.open(io.BytesIO(page.locator("#map").screenshot())).convert("RGB"), float)
    return float((shot[100:-100, 100:-100].std(axis=2) > 20).mean())


def until(page, done):
    end = time.monotonic() + 240.0
    while time.monotonic() < end:
        if done():
            return
        page.wait_for_timeout(200)
    raise AssertionError("it did not come")


def test_the_map_appears_as_pictures_come(page):
    served, page = page
    page.wait_for_selector("#panel-fly:has-text('No vehicle yet')")
    before = colours(page)
    for shot in line(6, "falcon <b>"):
        served.send(shot)
    page.wait_for_selector(".tile:has-text('falcon <b>')")  # a name is a text, not a piece of the page
    page.click("#tab-map")
    page.wait_for_selector("[data-layer=realtime][data-empty=false]")
    until(page, lambda: colours(page) > before + 0.004)
    shown = colours(page)
    levels = {int(tile.split("/")[1]) for tile in page.tiles}
    assert levels and min(levels) > 10  # the tiles of the whole world, which are empty, are not asked for first
    for box in page.locator("[data-layer] input[type=checkbox]").all():
        box.uncheck()
    until(page, lambda: colours(page) < shown - 0.004)
    page.click("text=Refine all now")
    page.wait_for_selector(".jobs [data-state=done]")


@pytest.mark.slow
def test_an_area_is_drawn_and_planned(page):
    _, page = page
    page.click("#tab-plan")
    page.evaluate("orthoswarm.map.jumpTo({center: [103.2, 30.57], zoom: 16})")
    page.click("text=Draw area")
    for x, y in ((500, 250), (800, 250), (800, 550), (500, 550)):
        page.mouse.click(x, y)
        page.wait_for_timeout(400)
    page.fill("[name=vehicles]", "2")
    page.click("text=Make plan")
    page.wait_for_selector(".plan-result:not([hidden])")
    until(page, lambda: page.locator(".assignments li").count() == 2)
    page.click("text=Upload missions")
    page.wait_for_selector(".notice[data-level=bad]:has-text('No vehicle flies Route A, Route B')")  # nobody was heard
    page.wait_for_timeout(2500)
    page.click(".notice button")  # it stays until it is dismissed
    page.wait_for_selector(".notice", state="detached")


def test_before_and_after_reach_over_the_whole_map(page):
    _, page = page
    page.click("#tab-map")
    page.check("#swipe-on")
    slider, chart = page.locator("#swipe").bounding_box(), page.locator("#map").bounding_box()
    assert abs(slider["width"] - chart["width"]) < 3
    for share in (0, 250, 1000):
        page.locator("#swipe").fill(str(share))
        at = chart["x"] + slider["width"] * share / 1000
        until(page, lambda at=at: abs((page.locator("#divider").bounding_box() or {"x": -99.0})["x"] - at) < 5)
    page.uncheck("#swipe-on")
    page.wait_for_selector("#divider", state="hidden")


def test_it_fits_a_tablet(page):
    _, page = page
    page.set_viewport_size({"width": TABLET[0], "height": TABLET[1]})
    panel, chart = page.locator("#side").bounding_box(), page.locator("#map").bounding_box()
    assert panel["x"] + panel["width"] <= chart["x"] + 1
    assert chart["width"] > 600
    for button in page.locator("button:visible, select:visible").all():
        box = button.bounding_box()
        assert box["height"] >= 44
        assert box["width"] >= 44
