"""Photos in a store on a cluster: the workers share no folder, and the map is the same."""

import os
import re

import pytest

pytest.importorskip("s3fs", reason="needs the extra 'cloud'")
pytest.importorskip("moto", reason="needs the S3 server of moto[s3] with flask and flask-cors")
pytest.importorskip("flask_cors", reason="needs the S3 server of moto[s3] with flask and flask-cors")
pytest.importorskip("distributed", reason="needs the extra 'cluster'")

from gcs_plugin.cli.main import main
from orthoswarm.stores import requests
from orthoswarm.stores.addresses import path_of
from orthoswarm.stores.local_copies import content
from tests.kit.scene import Scene, legs
from tests.kit.servers.loopback_cluster import Loopback
from tests.kit.servers.store_server import ENVIRONMENT, s3_server


def test_workers_without_a_shared_folder_give_the_same_map(tmp_path, monkeypatch, capsys):
    scene = Scene()
    for vehicle in "ab":
        scene.fly(tmp_path / "site" / "photos" / vehicle, legs(count=2, photos=5))
    scene.basemap(tmp_path / "site" / "before.tif")
    with s3_server() as server:
        variables = {**ENVIRONMENT, "AWS_ENDPOINT_URL": server}
        for name, value in {**variables, "ORTHOSWARM_CACHE": str(tmp_path / "here")}.items():
            monkeypatch.setenv(name, value)
        requests._file_systems.clear()
        requests.file_system(path_of("s3://flood")).mkdir("flood")
        requests.file_system(path_of("s3://flood")).put(f"{tmp_path / 'site'}/", "flood/site", recursive=True)
        asked = ["--gsd", "0.5", "--workers", "1"]
        local = ["mosaic", str(tmp_path / "site" / "photos"), "--basemap", str(tmp_path / "site" / "before.tif")]
        assert main([*local, "--out", str(tmp_path / "out"), *asked]) == 0
        there = tmp_path / "there"
        with Loopback(tmp_path, **variables, ORTHOSWARM_CACHE=str(there)) as cluster:
            cluster.begin(2)
            remote = ["mosaic", "s3://flood/site/photos", "--basemap", "s3://flood/site/before.tif"]
            assert main([*remote, "--out", "s3://flood/map", "--cluster", cluster.address, *asked]) == 0
            refused = ["mosaic", str(tmp_path / "site" / "photos"), "--out", "s3://flood/map2"]
            assert main([*refused, "--cluster", cluster.address]) == 2
        assert re.search("--out has to be a folder", capsys.readouterr().err)
        for name in ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl"):
            assert content(path_of(f"s3://flood/map/{name}")) == (tmp_path / "out" / name).read_bytes(), name
    requests._file_systems.clear()
    fetched = {name for _, _, names in os.walk(there) for name in names}
    assert "before.tif" in fetched and any(name.endswith(".JPG") for name in fetched)  # the workers refined
