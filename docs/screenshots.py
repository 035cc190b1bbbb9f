"""Take the pictures of the console in docs/images anew: the real daemon, headless Chromium, the demonstration.

    python docs/screenshots.py [--out docs/images] [--keep FOLDER]

Needs Playwright for Python and a Chromium on the PATH. Takes as long as the demonstration, some two minutes. FOLDER
keeps the demonstration's workspace; one that is there already is shown as it is, without pictures of the flight.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

FLAGS = ["--no-sandbox", "--disable-gpu", "--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run"]
DESK, TABLET, PHONE = (1440, 900), (1024, 768), (390, 844)
LIMIT_MS = 600_000
DRAWN_MS = 4000
TILES = "[...document.querySelectorAll('.tile .pictures')]"
COME = TILES + ".reduce((n, e) => n + parseInt(e.textContent.split('/')[0]), 0)"


class Program:
    """`orthoswarm ...` that serves a page, and its address."""

    def __init__(self, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gcs_plugin.cli", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert self.process.stdout is not None
        self.url = ""
        for line in self.process.stdout:
            found = re.search(r"map: (http://\S+?)/?(#|\s)", line)
            if found:
                self.url = found[1]
                break
        threading.Thread(target=self.process.stdout.read, daemon=True).start()

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(60)


def opened(browser: Any, url: str, size: tuple[int, int], theme: str = "dark") -> Any:
    """The console in a window of a size and a theme."""
    page = browser.new_context(viewport={"width": size[0], "height": size[1]}).new_page()
    page.add_init_script(
        f"localStorage.getItem('orthoswarm-settings') || "
        f"localStorage.setItem('orthoswarm-settings', JSON.stringify({{theme: '{theme}', sound: false}}))"
    )
    page.goto(url)
    page.wait_for_function("() => window.orthoswarm", timeout=LIMIT_MS)
    return page


def flight(browser: Any, demo: Program, out: Path) -> None:
    """While vehicles fly: their first pictures are on the map."""
    page = opened(browser, demo.url, DESK)
    phone = opened(browser, demo.url, PHONE, "sunlight")
    page.wait_for_function(f"() => ({COME}) > 60", timeout=LIMIT_MS)
    page.click(".tile >> nth=1")
    shoot(page, out / "daemon-flight.jpg")
    shoot(phone, out / "daemon-phone.jpg")
    page.context.close()
    phone.context.close()


def afterwards(browser: Any, served: Program, token: str, out: Path) -> None:
    """The refined map, the swipe, a tablet, a plan."""
    page = opened(browser, f"{served.url}/#token={token}", DESK)
    page.wait_for_selector(".tile >> nth=2", timeout=LIMIT_MS)
    page.click("#tab-map")
    shoot(page, out / "daemon-page.jpg")
    page.check("#swipe-on")
    page.wait_for_timeout(DRAWN_MS)
    shoot(page, out / "daemon-swipe.jpg")
    page.uncheck("#swipe-on")
    plan(page, out / "daemon-plan.jpg")
    coverage(page, out / "coverage-page.jpg")
    page.context.close()
    page = opened(browser, served.url, TABLET, "sunlight")
    page.wait_for_selector(".tile >> nth=2", timeout=LIMIT_MS)
    page.click("#tab-map")
    shoot(page, out / "daemon-tablet.jpg")
    page.context.close()


def plan(page: Any, path: Path) -> None:
    """Draw an area over the one that was flown, and plan it."""
    page.click("#tab-plan")
    if page.is_visible("text=Clear >> nth=0"):  # a workspace that is shown again has an area
        page.click("text=Clear >> nth=0")
    page.click("text=Draw area")
    for x, y in ((560, 200), (1180, 170), (1260, 640), (620, 690)):
        page.mouse.click(x, y)
        page.wait_for_timeout(400)
    page.click("text=Make plan")
    page.wait_for_selector(".plan-result:not([hidden])", timeout=LIMIT_MS)
    page.locator(".plan-result").scroll_into_view_if_needed()
    shoot(page, path)


def coverage(page: Any, path: Path) -> None:
    """What the flight saw of the area that was drawn for the plan, which is larger than what was flown."""
    page.click("#tab-map")
    page.wait_for_selector(".gaps li", timeout=LIMIT_MS)
    page.locator(".coverage").scroll_into_view_if_needed()
    shoot(page, path)


def shoot(page: Any, path: Path) -> None:
    """Take a picture of what the page shows, once all tiles are there."""
    page.wait_for_timeout(DRAWN_MS)
    for _ in range(60):
        if page.evaluate("orthoswarm.map.areTilesLoaded()"):
            break
        page.wait_for_timeout(500)
    page.wait_for_timeout(500)
    page.screenshot(path=path, type="jpeg", quality=85)
    print(path, flush=True)


def main() -> None:
    """Take them all."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images")
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=FLAGS)
        workspace = args.keep or Path(folder) / "demo"
        if not (workspace / "orthoimage.tif").exists():
            with Program("demo", "--no-browser", "--out", str(workspace)) as demo:
                flight(browser, demo, args.out)
                demo.process.wait()
        basemap = str(workspace / "twin" / "basemap.tif")
        with Program("serve", "--port", "0", "--workspace", str(workspace), "--basemap", basemap) as served:
            afterwards(browser, served, (workspace / "token").read_text().strip(), args.out)
        browser.close()


if __name__ == "__main__":
    main()
