"""The offline pack's page, opened from a folder: no server, no internet."""

import json
import zipfile

from orthoswarm.export.sheets.pack import write_pack
from orthoswarm.export.tactical.places import FILE, read_places, write_geojson
from tests.export.test_date_line import make
from tests.export.test_sheets import FIND, folder  # noqa: F401
from tests.kit.page_kit import DESK, LIMIT_MS, PHONE


def test_the_packs_page_shows_map_finds_and_files_from_a_folder(browser, folder, tmp_path):  # noqa: F811
    write_geojson([FIND], folder / FILE)
    write_pack(folder / "orthoimage.tif", tmp_path / "pack.zip", read_places(folder))
    with zipfile.ZipFile(tmp_path / "pack.zip") as archive:
        archive.extractall(tmp_path / "out")
    for size in (DESK, PHONE):
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        page = context.new_page()
        page.set_default_timeout(LIMIT_MS)
        errors, asked = [], []
        page.on("pageerror", lambda error, errors=errors: errors.append(str(error)))
        page.on("request", lambda request, asked=asked: asked.append(request.url))
        page.goto((tmp_path / "out" / "flood-map" / "index.html").as_uri())
        page.wait_for_function("() => [...document.querySelectorAll('#map img')].some((i) => i.naturalWidth === 256)")
        assert page.locator(".mark").count() == 1 and "Roof" in page.inner_text("#finds")
        assert "2 of 3 legs" in page.inner_text("#accuracy")
        for href in page.eval_on_selector_all(".file", "links => links.map((l) => l.getAttribute('href'))"):
            assert (tmp_path / "out" / "flood-map" / href).is_file()
        before = page.locator(".mark").bounding_box()
        page.focus("#map")
        page.keyboard.press("ArrowRight")
        assert page.locator(".mark").bounding_box()["x"] < before["x"]
        page.click("#in")
        page.click("#finds button")
        assert errors == [] and all(url.startswith("file:") for url in asked)
        context.close()


def test_the_pack_says_which_pictures_are_not_refined(browser, folder, tmp_path):  # noqa: F811
    report = json.loads((folder / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps(report | {"unrefined": {"v2": 120}}))
    write_pack(folder / "orthoimage.tif", tmp_path / "pack.zip")
    with zipfile.ZipFile(tmp_path / "pack.zip") as archive:
        archive.extractall(tmp_path / "out")
    stac = json.loads((tmp_path / "out" / "flood-map" / "orthoimage.stac.json").read_text())
    assert "Not refined when this was written" in stac["properties"]["description"]
    page = browser.new_page()
    page.set_default_timeout(LIMIT_MS)
    page.goto((tmp_path / "out" / "flood-map" / "index.html").as_uri())
    page.wait_for_function("document.getElementById('accuracy').textContent")
    assert "pictures 120 of v2" in page.inner_text("#accuracy") and "2 of 3 legs" in page.inner_text("#accuracy")
    page.close()


def test_the_page_shows_a_map_on_the_meridian_of_180_degrees_in_one_piece(browser, tmp_path):
    make(tmp_path / "map", 400, 600)
    write_pack(tmp_path / "map" / "orthoimage.tif", tmp_path / "pack.zip")
    with zipfile.ZipFile(tmp_path / "pack.zip") as archive:
        archive.extractall(tmp_path / "out")
    context = browser.new_context(viewport={"width": DESK[0], "height": DESK[1]})
    page = context.new_page()
    page.set_default_timeout(LIMIT_MS)
    page.goto((tmp_path / "out" / "map-map" / "index.html").as_uri())
    page.wait_for_function("() => [...document.querySelectorAll('#map img')].some((i) => i.naturalWidth === 256)")
    tiles = page.eval_on_selector_all(
        "#map img",
        "images => images.map((i) => [...i.src.match(/(\\d+)\\/(\\d+)\\/\\d+.webp/).slice(1, 3), i.style.left])",
    )
    at = {int(column): float(left.removesuffix("px")) for _, column, left in tiles}
    last = 2 ** int(tiles[0][0]) - 1
    assert 0 < at[0] - at[last] < 600 and -600 < at[last] < DESK[0]  # side by side, and on the screen
    assert abs(float(page.inner_text("#where").split(",")[1])) > 179.9
    context.close()
