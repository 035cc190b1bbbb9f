"""Surveyed points on the page: loaded from a table, marked in pictures, measured at once, written as gcp_list.txt."""

import numpy as np
import pytest

from orthoswarm.evaluation.checkpoints import read_checkpoints
from tests.kit.daemon_kit import GRID, line, serving
from tests.kit.page_kit import opened, poll


@pytest.mark.slow
def test_a_point_takes_one_press_in_each_picture(browser, tmp_path):
    shots = line(4)
    ground = shots[1].camera.to_ground(np.array([95.0, 65.0]), 0.0)
    lat, lon = (float(v) for v in GRID.to_geographic(ground))
    (tmp_path / "points.csv").write_text(f"name,lat_deg,lon_deg\nP1,{lat},{lon}\n")
    with serving(tmp_path / "w") as served:
        for shot in shots:
            assert served.send(shot).status_code == 201
        served.until("/api/frames", lambda rows: len(rows) == 4 and all(row["on_map"] for row in rows))
        with opened(browser, f"{served.url}/#token={served.token}", fake=False) as page:
            page.click("#tab-map")
            page.set_input_files("input[aria-label='Load a table']", tmp_path / "points.csv")
            page.click(".finds >> text=P1")
            page.wait_for_function(
                "() => [...document.querySelectorAll('.crop img')].filter((i) => i.naturalWidth).length > 2"
            )
            for n in range(3):
                area = page.locator(".crop").nth(n)
                area.scroll_into_view_if_needed()
                box = area.bounding_box()
                area.click(position={"x": box["width"] / 2, "y": box["height"] / 2})  # where it should be
                page.wait_for_selector(f".find-pictures [role=status]:has-text('{n + 1} of 3 marked')")
            poll(page, lambda: "rays meet within 0.0" in page.text_content(".find-pictures [role=status]"))
            first = served.get("/api/points").json()[0]["marks"][0]
            page.locator(".crop").first.focus()
            for _ in range(8):
                page.keyboard.press("ArrowRight")
            poll(page, lambda: served.get("/api/points").json()[0]["marks"][0]["column"] > first["column"] + 3.0)
            poll(page, lambda: page.text_content(".finds small") == page.text_content(".find-pictures [role=status]"))
            page.click("text=Larger")
            page.screenshot(path=tmp_path / "marks.png")
            page.locator("text=Take away").first.click()
            page.wait_for_selector(".find-pictures [role=status]:has-text('2 of 3 marked')")
            page.keyboard.press("Escape")
            with page.expect_download() as download:
                page.click("text=Save the marks")
            download.value.save_as(tmp_path / "gcp_list.txt")
    (point,) = read_checkpoints(tmp_path / "gcp_list.txt")
    assert point.name == "P1" and len(point.marks) == 2
    camera = {shot.pose["image"]: shot.camera for shot in shots}
    for mark in point.marks:
        u, v = camera[mark.image].project(np.array([[*ground, 0.0]]))[0]
        assert np.hypot(mark.column - u, mark.row - v) < 1.5
