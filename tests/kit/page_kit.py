"""The page in headless Chromium, over a station whose every word a test decides."""

import contextlib
import json
import mimetypes
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

WEB = Path(__file__).parents[2] / "gcs_plugin" / "web"
# The one without windows first: with their frames and tool bars, a page takes twice as long to open.
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, BROWSERS)), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
FLAGS += ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"]
DESK, TABLET, PHONE = (1440, 900), (1024, 768), (390, 844)
LIMIT_MS = 120_000

# Stands in for the station's event stream: the test sends each message, and decides whether the heart beats.
SOCKET = """
const now = () => Date.now() / 1000;
window.station = {
  beats: true, sockets: [],
  send(event) { for (const s of this.sockets) s.onmessage?.({ data: JSON.stringify(event) }); },
};
window.WebSocket = class {
  static OPEN = 1;
  constructor() {
    this.readyState = 0;
    if (!window.station.beats) { setTimeout(() => this.onclose?.(), 50); return; }
    window.station.sockets.push(this);
    setTimeout(() => {
      this.readyState = 1;
      this.onopen?.();
      window.station.send({ type: "hello", time: now() });
    }, 1);
  }
  close() {
    this.readyState = 3;
    window.station.sockets = window.station.sockets.filter((s) => s !== this);
    this.onclose?.();
  }
};
setInterval(() => { if (window.station.beats) window.station.send({ type: "heartbeat", time: now() }); }, 1000);
// Vehicles that were heard are heard on: two seconds later the page would call them old, five seconds later lost.
let heard = [];
const ask = () => fetch("/kit/heard").then((answer) => answer.json()).then((ids) => { heard = ids; }, () => {});
const shown = (id) => document.querySelector(`.tiles li[data-id="${id}"]`);
setInterval(() => {
  if (!window.station.beats) return;
  for (const id of heard.filter(shown)) window.station.send({ type: "vehicle", id, silent_s: 0.1 });
  ask();
}, 500);
ask();
"""
HEARD_S = 1.0  # a row that is silent for longer stays so


def vehicle(number: int, **more: Any) -> dict[str, Any]:
    """A row of /api/vehicles: on its mission, all well."""
    return {
        "id": f"v{number}", "system": number, "autopilot": "ardupilot", "link": "udp", "state": "found",
        "flight": {"state": "on mission", "text": "on mission 7/13", "item": 7, "items": 13}, "armed": True,
        "mode": "AUTO", "silent_s": 0.1,
        "lat_deg": 47.3977 + 0.0004 * (number // 10), "lon_deg": 8.5456 + 0.0004 * (number % 10), "height_m": 80.0,
        "heading_deg": 10.0 * number, "speed_m_s": 8.0, "battery": 0.8, "gps_fix": 3, "satellites": 14,
        "mission": {"phase": "active", "item": 7, "items": 13}, "photos": 20, "frames": {"frames": 18},
    } | more  # fmt: skip


@dataclass
class Station:
    """An HTTP server with the page's files, and answers that a test sets.

    Attributes:
        gets: path -> JSON value of a GET.
        answer: called with method, path and body of everything else; gives status and JSON value.
        heard: what was asked with other methods, in order: method, path, body.
    """

    gets: dict[str, Any] = field(default_factory=dict)
    answer: Callable[[str, str, Any], tuple[int, Any]] = lambda method, path, body: (404, {"detail": "no such route"})
    heard: list[tuple[str, str, Any]] = field(default_factory=list)
    url: str = ""

    def commands(self, verb: str) -> list[Any]:
        """Bodies of the commands with a verb."""
        return [body for method, path, body in self.heard if method == "POST" and path.endswith(f"/{verb}")]


def _heard(rows: list[Any]) -> list[str]:
    """The ids of vehicles on links that are heard; rows may hold anything."""
    known = [row for row in rows if isinstance(row, dict) and isinstance(row.get("id"), str) and row.get("system")]
    return [row["id"] for row in known if 0.0 <= row.get("silent_s", -1.0) < HEARD_S]


@contextlib.contextmanager
def standing(*rows: dict[str, Any]) -> Iterator[Station]:
    """A station with vehicles, on a free port of this machine."""
    station = Station()
    station.gets = {
        "/api/vehicles": list(rows), "/api/layers": [], "/api/jobs": [], "/api/completions": [], "/api/finds": [],
        "/api/traffic": [],
        "/api/legs": {"type": "FeatureCollection", "features": []},
        "/api/coverage": {"state": "no area", "seen_share": None},
        "/healthz": {"status": "ok", "problems": []},
    }  # fmt: skip

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"  # a page asks for eighty files

        def do_GET(self) -> None:
            path = self.path.split("?")[0]
            if path == "/kit/heard":
                self._send(200, json.dumps(_heard(station.gets["/api/vehicles"])).encode(), "application/json")
                return
            if path in station.gets:
                self._send(200, json.dumps(station.gets[path]).encode(), "application/json")
                return
            file = WEB / ("static/index.html" if path == "/" else path.lstrip("/"))
            kind = "text/javascript" if file.suffix == ".mjs" else mimetypes.guess_type(file.name)[0]
            if file.is_file():
                self._send(200, file.read_bytes(), kind or "application/octet-stream")
            else:
                self._send(404, b'{"detail": "no such route"}', "application/json")

        def _other(self) -> None:
            data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            with contextlib.suppress(ValueError):
                data = json.loads(data)
            station.heard.append((self.command, self.path, data))
            status, value = station.answer(self.command, self.path, data)
            self._send(status, json.dumps(value).encode(), "application/json")

        do_POST = do_PUT = do_DELETE = _other

        def _send(self, status: int, body: bytes, kind: str) -> None:
            with contextlib.suppress(ConnectionError):
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)  # it looks so often for its end
    thread.start()
    station.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield station
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextlib.contextmanager
def opened(browser: Any, url: str, size: tuple[int, int] = DESK, *, fake: bool = True, **options: Any) -> Iterator[Any]:
    """The page of a station; its errors and foreign requests fail the test."""
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, **options)
    page = context.new_page()
    page.set_default_timeout(LIMIT_MS)
    errors: list[str] = []
    foreign: list[str] = []
    base = url.split("#")[0].rstrip("/")
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda r: None if r.url.startswith((base, "blob:", "data:")) else foreign.append(r.url))
    if fake:
        page.add_init_script(SOCKET)
    page.goto(url)
    page.wait_for_function("() => window.orthoswarm")
    yield page
    assert errors == []
    assert foreign == []  # it works without the internet
    context.close()


def send(page: Any, event: dict[str, Any]) -> None:
    """An event on the stream."""
    page.evaluate("(event) => station.send(event)", event)


def poll(page: Any, done: Callable[[], Any], limit_s: float = LIMIT_MS / 1000) -> None:
    """Wait until something holds that the page does not show."""
    end = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < end, "it did not come true"
        page.wait_for_timeout(50)


def refused(page: Any, words: str) -> None:
    """Neither upload nor start of the shown plan goes on: each press is answered by a notice with these words."""
    for press in ("Upload missions", "Check and start"):
        page.click(f"text={press}")
        page.wait_for_selector(f".notice:has-text('{words}')")
        page.click(f".notice:has-text('{words}') button")
    assert page.locator("dialog[open]").count() == 0


def saved(page: Any) -> None:
    """Wait until what was drawn and filled in is with the station."""
    poll(page, lambda: page.evaluate("import('/static/plan/shared.js').then((m) => !m.isSaving())"))


def ok_for_all(station: Station, outcome: str = "done", reason: str = "") -> None:
    """Every command ends alike."""

    def answer(method: str, path: str, body: Any) -> tuple[int, Any]:
        _, _, _, who, verb = [*path.split("/"), "", ""][:5]
        ids = [row["id"] for row in station.gets["/api/vehicles"]] if who == "all" else [who]
        rows = [{"id": body["id"], "vehicle": v, "command": verb, "outcome": outcome, "reason": reason} for v in ids]
        return 200, {"id": body["id"], "results": rows} if who == "all" else rows[0]

    station.answer = answer
