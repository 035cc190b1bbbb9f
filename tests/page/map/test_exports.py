"""What was exported stays within reach, and says when the map has changed since."""

from datetime import UTC, datetime, timedelta

import pytest

from tests.kit.page_kit import opened, send, standing, vehicle

T = "2026-05-28T20:{}:00Z"


def job(number, kind, minute, files=None):
    row = {"id": number, "kind": kind, "vehicle": None, "sortie": None, "state": "done", "progress": 1, "message": ""}
    ended = row | {"created": T.format(minute), "started": T.format(minute), "ended": T.format(minute)}
    return ended | {"attempts": 1, "detail": {} if files is None else {"files": files}}


def test_a_pack_stays_when_the_daemon_exports_by_itself_and_says_that_it_is_older_than_the_map(browser):
    with standing(vehicle(1)) as station:
        station.gets["/api/jobs"] = [job(2, "export", 11, {"pack": "export/map.zip"}), job(1, "refine", 10)]
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            pack = page.locator(".files a:has-text('map.zip')")
            pack.wait_for()
            assert "older" not in pack.inner_text()
            send(page, {"type": "job", **job(3, "refine", 12)})
            send(page, {"type": "job", **job(4, "export", 13, {"cog": "orthoimage.tif", "gpkg": "footprints.gpkg"})})
            page.wait_for_selector(".files a:has-text('orthoimage.tif')")
            assert "/api/export/2/pack" in pack.get_attribute("href")
            assert "older than the map" in pack.inner_text()
            assert page.locator(".files a:has-text('older')").count() == 1
            send(page, {"type": "job", **job(5, "export", 14, {"pack": "export/map.zip"})})
            page.wait_for_selector(".files a[href*='/api/export/5/pack']")
            assert page.locator(".files a").count() == 3
            assert page.locator(".files a:has-text('older')").count() == 0


def test_a_file_of_another_day_says_which(browser):
    now = datetime.now(UTC)
    if now + timedelta(minutes=5) > now.replace(hour=23, minute=59):
        pytest.skip("midnight is near")
    rows = []
    for number, (kind, ended) in enumerate((("pack", now), ("cog", now - timedelta(days=1)))):
        rows.append(job(number, "export", 11, {kind: f"{kind}.bin"}) | {"ended": ended.isoformat()})
    with standing(vehicle(1)) as station:
        station.gets["/api/jobs"] = rows
        with opened(browser, station.url, timezone_id="UTC") as page:
            page.click("#tab-map")
            page.wait_for_selector(".files a:has-text('cog.bin')")
            today, yesterday = (page.inner_text(f".files a:has-text('{name}.bin')") for name in ("pack", "cog"))
    assert today.endswith(f"pack.bin, {now:%H:%M} UTC")
    assert yesterday.endswith(f"cog.bin, {now - timedelta(days=1):%Y-%m-%d %H:%M} UTC")
