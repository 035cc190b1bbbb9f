"""Photos in a store on a cluster: the workers share no folder, and the map is the same."""

import os
import re

import pytest

pytest.importorskip("distributed", reason="needs the extra 'cluster'")

from gcs_plugin.cli.main import main
from orthoswarm.stores import requests
from orthoswarm.stores.addresses import path_of
from orthoswarm.stores.local_copies import content
from tests.kit.scene import Scene, legs
from tests.kit.servers.loopback_cluster import Loopback
from tests.kit.servers.store_server import GS, S3, store_server


@pytest.mark.parametrize("kind", [pytest.param(S3, id="s3"), pytest.param(GS, id="gs", marks=pytest.mark.slow)])
def test_workers_without_a_shared_folder_give_the_same_map(kind, tmp_path, monkeypatch, capsys):
    kind.require()
    flood = f"{kind.scheme}://flood"
    scene = Scene()
    for vehicle in "ab":
        scene.fly(tmp_path / "site" / "photos" / vehicle, legs(count=2, photos=5))
    scene.basemap(tmp_path / "site" / "before.tif")
    with store_server(kind) as server:
        variables = {**kind.environment, kind.endpoint: server}
        for name, value in {**variables, "ORTHOSWARM_CACHE": str(tmp_path / "here")}.items():
            monkeypatch.setenv(name, value)
        requests._file_systems.clear()
        requests.file_system(path_of(flood)).mkdir("flood")
        requests.file_system(path_of(flood)).put(f"{tmp_path / 'site'}/", "flood/site", recursive=True)
        asked = ["--gsd", "0.5", "--workers", "1"]
        local = ["mosaic", str(tmp_path / "site" / "photos"), "--basemap", str(tmp_path / "site" / "before.tif")]
        assert main([*local, "--out", str(tmp_path / "out"), *asked]) == 0
        there = tmp_path / "there"
        with Loopback(tmp_path, **variables, ORTHOSWARM_CACHE=str(there)) as cluster:
            cluster.begin(2)
            remote = ["mosaic", f"{flood}/site/photos", "--basemap", f"{flood}/site/before.tif"]
            assert main([*remote, "--out", f"{flood}/map", "--cluster", cluster.address, *asked]) == 0
            refused = ["mosaic", str(tmp_path / "site" / "photos"), "--out", f"{flood}/map2"]
            assert main([*refused, "--cluster", cluster.address]) == 2
        assert re.search("--out has to be a folder", capsys.readouterr().err)
        for name in ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl"):
            same = content(path_of(f"{flood}/map/{name}")) == (tmp_path / "out" / name).read_bytes()
            assert same, name  # pytest would compare millions of bytes for its message
    requests._file_systems.clear()
    fetched = {name for _, _, names in os.walk(there) for name in names}
    assert "before.tif" in fetched and any(name.endswith(".JPG") for name in fetched)  # the workers refined
