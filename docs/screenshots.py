"""Take the pictures of the daemon's page in docs/images anew: the real daemon, headless Chromium, the demonstration.

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
DESK, TABLET = {"width": 1280, "height": 800}, {"width": 768, "height": 1024}
LIMIT_MS = 600_000
DRAWN_MS = 4000


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


def flight(browser: Any, demo: Program, out: Path) -> None:
    """While vehicles fly: some legs are over, no vehicle is complete."""
    page = browser.new_page(viewport=DESK)
    page.goto(demo.url)
    page.wait_for_selector("#leg-count:text-matches('^([3-9]|[1-9][0-9]) legs')", timeout=LIMIT_MS)
    page.wait_for_timeout(DRAWN_MS)
    shoot(page, out / "daemon-flight.jpg")
    page.close()


def afterwards(browser: Any, served: Program, token: str, out: Path) -> None:
    """The refined map, the swipe, a tablet, a plan."""
    page = browser.new_page(viewport=DESK)
    page.goto(f"{served.url}/#token={token}")
    page.wait_for_selector("#vehicles .card >> nth=2", timeout=LIMIT_MS)
    page.wait_for_timeout(DRAWN_MS)
    shoot(page, out / "daemon-page.jpg")
    page.check("#swipe-on")
    page.wait_for_timeout(DRAWN_MS)
    shoot(page, out / "daemon-swipe.jpg")
    page.uncheck("#swipe-on")
    plan(page, out / "daemon-plan.jpg")
    page.close()
    page = browser.new_page(viewport=TABLET, has_touch=True, device_scale_factor=1)
    page.goto(served.url)
    page.wait_for_selector("#vehicles .card >> nth=2", timeout=LIMIT_MS)
    page.wait_for_timeout(DRAWN_MS)
    shoot(page, out / "daemon-tablet.jpg")
    page.close()


def plan(page: Any, path: Path) -> None:
    """Draw an area beside the one that was flown, plan it, and ask to upload it."""
    page.click("#draw")
    for x, y in ((180, 170), (700, 130), (780, 620), (250, 660)):
        page.mouse.click(x, y)
        page.wait_for_timeout(400)
    page.click("#make")
    page.wait_for_selector("#plan-result >> text=covered in", timeout=LIMIT_MS)
    page.locator("#plan-result").scroll_into_view_if_needed()
    page.wait_for_timeout(DRAWN_MS)
    shoot(page, path)


def shoot(page: Any, path: Path) -> None:
    """Take a picture of what the page shows, once all tiles are there."""
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
