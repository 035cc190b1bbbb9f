"""`orthoswarm basemap`: tiles of a server in a file that is a basemap; what stops it loses nothing."""

import json
import sqlite3
import threading
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.plans import basemap_download
from orthoswarm.export.tiles.tile_pyramid import tile_of
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.basemap import Basemap

LAT, LON, DEEPEST = 47.4, 8.5, 18


def shade(z, x, y):
    """A grey level for each tile of the deepest zoom; the coarser ones show that of their north-west one."""
    k = DEEPEST - z
    return 20 + 10 * ((x << k) % 7) + 20 * ((y << k) % 8)


class Tiles(BaseHTTPRequestHandler):
    """A tile server with a hole, that may fail after some tiles."""

    def do_GET(self):
        server = self.server
        if self.path == "/about.json":
            said = {
                "tiles": [server.base + "/{z}/{x}/{y}.png"],
                "maxzoom": DEEPEST,
                "attribution": "(c) <a href='x'>Mapmakers</a>",
            }
            return self.answer(json.dumps(said).encode())
        server.asked.append(self.path)
        if len(server.asked) > server.until:
            return self.send_error(503)
        if len(server.asked) == server.cut:  # the connection ends in the middle of a tile
            self.send_response(200)
            self.send_header("Content-Length", "1000")
            self.end_headers()
            return self.wfile.write(b"\x89PNG")
        if server.refuses:
            return self.send_error(403)
        z, x, y = (int(part.split(".")[0]) for part in self.path.strip("/").split("/"))
        if z > DEEPEST or (z == DEEPEST and (x + y) % 10 == 0):
            return self.send_error(404)
        rough = np.random.default_rng([x, y]).integers(-15, 16, (256, 256, 1)) + shade(
            z, x, y
        )  # one colour is a placeholder
        return self.answer(cv2.imencode(".png", np.repeat(rough, 3, 2).astype(np.uint8))[1].tobytes())

    def answer(self, content):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_):
        pass


@contextmanager
def serving(until=10**9, refuses=False, cut=0):
    server = ThreadingHTTPServer(("127.0.0.1", 0), Tiles)
    server.asked, server.until, server.refuses, server.cut = [], until, refuses, cut
    server.base = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(basemap_download, "_PAUSE_S", 0.0)


@pytest.fixture
def area(tmp_path):
    side = 0.004
    ring = [[LON, LAT], [LON + side, LAT], [LON + side, LAT + side], [LON, LAT + side], [LON, LAT]]
    path = tmp_path / "area.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return path


def fetch(address, area, out, *more):
    return main(["basemap", address, "--area", str(area), "--out", str(out), "--gsd", "0.5", *map(str, more)])


def test_the_file_is_a_basemap_and_says_whose_it_is(area, tmp_path, capsys):
    out = tmp_path / "before.mbtiles"
    with serving() as server:
        assert fetch(server.base + "/about.json", area, out) == 0
        assert len(server.asked) == len(set(server.asked))
    said = capsys.readouterr().out
    assert "to zoom 18, 0.40 m a pixel" in said and "lacks" in said and "no licence" not in said
    with closing(sqlite3.connect(out)) as database:
        about = dict(database.execute("SELECT * FROM metadata"))
    assert (
        "source" not in about
        and "Mapmakers" in about["attribution"]
        and about["minzoom"] == "13"
        and about["maxzoom"] == "18"
    )
    grid = LocalGrid(32632)
    middle = grid.to_grid(LAT + 0.002, LON + 0.002)
    around = BoundingBox.around_points(middle, 250.0)
    basemap = Basemap.open(out, 32632, around)
    assert basemap.native_gsd_m == pytest.approx(0.404, abs=0.01)
    assert basemap.attribution == "(c) Mapmakers"
    gray, valid = basemap.gray(around, 0.5)
    assert valid.mean() > 0.95
    lat, lon = grid.to_geographic(middle)
    x, y = tile_of(lon, lat, DEEPEST)
    if (x + y) % 10:
        assert gray[496:504, 496:504].mean() == pytest.approx(shade(DEEPEST, x, y), abs=8)


def test_it_goes_on_where_the_server_failed(area, tmp_path, capsys):
    out = tmp_path / "before.mbtiles"
    with serving(until=20) as server:
        template = server.base + "/{z}/{x}/{y}.png"
        assert fetch(template, area, out) == 1
        assert "goes on from there" in capsys.readouterr().err and not out.exists()
        first, server.until = set(server.asked[:16]), 10**9
        server.asked.clear()
        assert fetch(template, area, out) == 0
        assert not first & set(server.asked)
    assert out.exists() and list(tmp_path.glob(".*.part")) == []
    assert "the server names no licence" in capsys.readouterr().out


def test_a_tile_that_is_cut_off_is_asked_for_again(area, tmp_path):
    with serving(cut=3) as server:
        assert fetch(server.base + "/{z}/{x}/{y}.png", area, tmp_path / "before.mbtiles") == 0
        assert len(server.asked) == len(set(server.asked)) + 1


@pytest.mark.parametrize(
    ("address", "more", "status", "said"),
    [
        ("{base}/{{z}}/{{x}}/{{y}}.png", ("--margin", "40000"), 2, "20,000 are the most"),
        ("{base}/nothing.json", (), 2, "gives no TileJSON"),
        ("tiles/{{z}}/{{x}}/{{y}}.png", (), 2, "is not an address"),
        ("{base}/{{z}}/{{x}}/{{y}}.png", ("--gsd", "0"), 2, "out of range"),
    ],
)
def test_what_cannot_be_fetched_is_refused(area, tmp_path, capsys, address, more, status, said):
    with serving() as server:
        assert fetch(address.format(base=server.base), area, tmp_path / "before.mbtiles", *more) == status
    assert said in capsys.readouterr().err and not list(tmp_path.glob("*.mbtiles"))


def test_a_server_that_refuses_or_has_nothing_is_named(area, tmp_path, capsys):
    with serving(refuses=True) as server:
        assert fetch(server.base + "/{z}/{x}/{y}.png", area, tmp_path / "a.mbtiles") == 1
        assert "refuses its tiles (403)" in capsys.readouterr().err
        assert fetch(server.base + "/{z}/{x}/{y}.txt/{-y}", area, tmp_path / "a.txt") == 2


def test_an_area_across_the_date_line_is_fetched_from_both_sides(tmp_path):
    ring = [[179.999, LAT], [-179.999, LAT], [-179.999, LAT + 0.002], [179.999, LAT + 0.002], [179.999, LAT]]
    (tmp_path / "area.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    with serving() as server:
        out = tmp_path / "m.mbtiles"
        assert fetch(server.base + "/{z}/{x}/{y}.png", tmp_path / "area.geojson", out, "--margin", 0) == 0
        columns = {int(path.split("/")[2]) for path in server.asked if path.startswith(f"/{DEEPEST}/")}
    assert {0, 2**DEEPEST - 1} <= columns and len(columns) < 8
