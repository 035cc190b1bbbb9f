"""Real autopilots of both kinds in one plan, from the page (`-m sitl`): flown, paused, resumed, and returned in turn.

ORTHOSWARM_SITL names three or more with different system numbers that stand some metres apart, of both kinds.
"""

import itertools
import json
import math
import threading

import pytest

from tests.kit.daemon_kit import serving
from tests.kit.page_kit import opened
from tests.page.conftest import browser  # noqa: F401
from tests.page.test_command_bar import confirm
from tests.page.test_operation import COUNT_DONE, ended_done, has_position, until
from tests.vehicles.autopilots.test_fleet_scenarios import ADDRESSES, charge
from tests.vehicles.autopilots.test_twin_camera import small_area

FLOWN_M_S = 2.0  # "paused" is said of one that holds; wind and its receiver move it a little
APART_M, LEVEL_M = 6.0, 4.5  # vehicles that are nearer than this, and less than this apart in height, may meet
DOWN = ("on ground", "complete")


class Watch(threading.Thread):
    """Compares each vehicle's word with its motion, and the vehicles' distances, until it is stopped."""

    def __init__(self, served):
        super().__init__(daemon=True)
        self.served, self.over, self.wrong, self.nearest_m = served, threading.Event(), [], math.inf
        self.words, self._since = {}, {}

    def run(self):
        while not self.over.wait(0.3):
            rows = [row for row in self.served.get("/api/vehicles").json() if has_position(row)]
            for row in rows:
                self.judge(row)
            for one, two in itertools.combinations([row for row in rows if row["height_m"] > 2.0], 2):
                north = (one["lat_deg"] - two["lat_deg"]) * 111_200
                east = (one["lon_deg"] - two["lon_deg"]) * 111_200 * math.cos(math.radians(one["lat_deg"]))
                if abs(one["height_m"] - two["height_m"]) < LEVEL_M:
                    self.nearest_m = min(self.nearest_m, math.hypot(north, east))

    def judge(self, row):
        """A word may be some seconds old: it is wrong if the motion contradicts it ten times in turn."""
        name, said = row["id"], row["flight"]["state"]
        if said not in self.words.setdefault(name, []):
            self.words[name].append(said)
        speed = row.get("speed_m_s") or 0.0
        no = (said == "paused" and speed > FLOWN_M_S) or (said in DOWN and row["armed"] and row["height_m"] > 5.0)
        self._since[name] = self._since.get(name, 0) + 1 if no else 0
        if self._since[name] > 10:
            self.wrong.append((name, said, speed, row["height_m"]))


@pytest.mark.sitl
@pytest.mark.timeout(1800)
def test_both_kinds_fly_one_plan_and_return_in_turn(browser, tmp_path):  # noqa: F811
    if len(ADDRESSES) < 3:
        pytest.skip("ORTHOSWARM_SITL names less than three autopilots")
    for address in ADDRESSES:
        charge(address)
    count, links = len(ADDRESSES), [text for address in ADDRESSES for text in ("--link", address)]
    with serving(tmp_path / "w", *links, "--fov-min", "75") as served:
        rows = served.until("/api/vehicles", lambda rows: sum(map(has_position, rows)) == count)
        assert {row["autopilot"] for row in rows} == {"ardupilot", "px4"}
        area = small_area(rows[0]["lat_deg"], rows[0]["lon_deg"], north_m=160.0, east_m=240.0)
        watch = Watch(served)
        watch.start()
        with opened(browser, f"{served.url}/#token={served.token}", fake=False) as page:
            page.set_default_timeout(300_000)
            page.evaluate(COUNT_DONE)
            page.click("#tab-plan")
            file = {"name": "area.geojson", "mimeType": "application/json", "buffer": json.dumps(area).encode()}
            page.set_input_files("input[type=file]", files=[file])
            page.wait_for_selector(".notice:has-text('area.geojson')")
            for name, value in (("vehicles", count), ("altitude_m", 40), ("fov_min_deg", 75)):
                page.fill(f"[name={name}]", str(value))
            page.click("text=Make plan")
            page.wait_for_selector(".plan-result:not([hidden])")
            page.click("text=Upload missions")
            ended_done(page, count)
            page.click("text=Check and start")
            page.wait_for_function("() => !document.querySelector('.preflight .primary')?.disabled")
            page.screenshot(path=tmp_path / "check.png")
            page.click(".preflight .primary")
            page.wait_for_selector(".preflight", state="hidden")
            page.click("#tab-fly")
            until(page, count, "t.startsWith('on mission')")
            page.evaluate("window.done = 0")
            page.click(".command[data-verb=pause]")
            confirm(page)
            until(page, count, "t.startsWith('paused')")
            ended_done(page, count)
            page.screenshot(path=tmp_path / "paused.png")
            page.click(".command[data-verb=resume]")
            confirm(page)
            until(page, count, "t.startsWith('on mission')")
            ended_done(page, count)
            page.wait_for_timeout(5_000)
            page.click(".command[data-verb=rtl]")
            page.wait_for_timeout(400)
            page.click("button:has-text('One by one')")
            until(page, count, "t.startsWith('returning') || t.startsWith('holding') || t.startsWith('paused')")
            page.screenshot(path=tmp_path / "returning.png")
            down = served.until("/api/vehicles", lambda rows: not any(row["armed"] for row in rows), 600.0)
            until(page, count, "!/on mission|paused|returning|landing|flying/.test(t)")
            page.screenshot(path=tmp_path / "down.png")
        watch.over.set()
        watch.join()
        print(watch.words, f"nearest {watch.nearest_m:.1f} m", [row["flight"]["text"] for row in down], tmp_path)
        assert not watch.wrong and watch.nearest_m > APART_M
        assert [c for c in served.get("/api/completions").json() if c.get("state") == "complete"] == []
