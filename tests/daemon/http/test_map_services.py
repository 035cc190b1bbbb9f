"""The map for other programs: TileJSON, WMTS as GDAL reads it, and pages of origins that the operator named."""

import io

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.windows import from_bounds

from gcs_plugin.daemon.settings import Settings
from orthoswarm.model.earth import WEB_MERCATOR_M
from orthoswarm.model.errors import InputError
from tests.kit.daemon_kit import line, serving, tile_over

ORIGIN = "https://maps.example"


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("map"), "--allow-origin", ORIGIN) as daemon:
        for shot in line(3):
            assert daemon.send(shot).status_code == 201
        daemon.until("/api/layers", lambda rows: not next(r for r in rows if r["name"] == "best")["empty"])
        yield daemon


def test_gdal_reads_the_tiles_by_the_capabilities(served):
    zoom, x, y = tile_over(line(3)[1].camera)
    side = WEB_MERCATOR_M / 2**zoom
    west, north = x * side - WEB_MERCATOR_M / 2, WEB_MERCATOR_M / 2 - y * side
    tile = np.asarray(Image.open(io.BytesIO(served.get(f"/tiles/best/{zoom}/{x}/{y}.png").content)).convert("RGBA"))
    with rasterio.open(f"WMTS:{served.url}/wmts,layer=best") as source:
        assert source.crs.to_epsg() == 3857
        window = from_bounds(west, north - side, west + side, north, source.transform)
        seen = source.read([1, 2, 3, 4], window=window, out_shape=(4, 256, 256), boundless=True)
    shown = (tile[..., 3] > 0) & (seen[3] > 0)
    assert shown.mean() > 0.05 and np.abs(seen[:3, shown].T.astype(int) - tile[shown][:, :3]).mean() < 6.0


def test_tilejson_leads_to_the_tiles(served):
    said = served.get("/tiles/best.json", params={"token": served.token}).json()
    zoom, x, y = tile_over(line(3)[1].camera)
    [template] = said["tiles"]
    address = template.format(z=zoom, x=x, y=y)
    assert address.startswith(served.url) and address.endswith(f"?token={served.token}")
    assert served.get(address.removeprefix(served.url)).headers["content-type"] == "image/png"
    west, south, east, north = said["bounds"]
    assert west < said["center"][0] < east and south < said["center"][1] < north
    assert served.get("/tiles/none.json").status_code == 404


@pytest.mark.parametrize("path", ["/tiles/best.json", "/wmts", "/api/layers", "/tiles/best/1/0/0.png"])
def test_pages_of_a_named_origin_read_the_map(served, path):
    answer = served.get(path, headers={"Origin": ORIGIN})
    assert answer.status_code == 200 and answer.headers["access-control-allow-origin"] == ORIGIN
    assert "access-control-allow-origin" not in served.get(path).headers
    assert served.get(path, headers={"Origin": "https://evil.example"}).status_code == 403


@pytest.mark.parametrize("path", ["/api/vehicles", "/api/frames", "/api/plan", "/"])
def test_they_read_nothing_else(served, path):
    assert served.get(path, headers={"Origin": ORIGIN}).status_code == 403
    assert served.post("/api/refine", headers={"Origin": ORIGIN}).status_code == 403


@pytest.mark.parametrize("origin", ["*", "maps.example", "https://maps.example/", "https://*"])
def test_what_is_no_origin_is_refused(tmp_path, origin):
    with pytest.raises(InputError, match="is no origin"):
        Settings(workspace=tmp_path, allow_origins=(origin,)).check()
