"""Maps from and into an S3 server on loopback: the same products as from folders, and failures in one sentence."""

import json
import re
import shutil
import sys

import pytest

pytest.importorskip("s3fs", reason="needs the extra 'cloud'")
pytest.importorskip("moto", reason="needs the S3 server of moto[s3] with flask and flask-cors")
pytest.importorskip("flask_cors", reason="needs the S3 server of moto[s3] with flask and flask-cors")

from gcs_plugin.cli.main import main
from orthoswarm.config import active
from orthoswarm.model.errors import InputError
from orthoswarm.stores import requests
from orthoswarm.stores.addresses import path_of
from orthoswarm.stores.listing import list_folder
from orthoswarm.stores.local_copies import cache_folder, clear_old_copies, content, local_file
from orthoswarm.stores.published_folder import PublishedFolder
from orthoswarm.stores.requests import NotStoredError, StoreLostError, StoreRequestError
from tests.kit.scene import Scene, legs
from tests.kit.servers.ports import free_port
from tests.kit.servers.store_server import ENVIRONMENT, FaultyProxy, s3_server

PRODUCTS = ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl")


@pytest.fixture(scope="module")
def server():
    with s3_server() as address:
        yield address


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Photos of one vehicle and a map."""
    folder = tmp_path_factory.mktemp("site")
    scene = Scene()
    scene.fly(folder / "photos" / "a", legs(count=2, photos=5))
    scene.basemap(folder / "before.tif")
    return folder


@pytest.fixture
def store(server, monkeypatch, tmp_path, configure):
    """A proxy before the server that this process uses, with an empty cache of its own; quick to give up."""
    proxy = FaultyProxy(server)
    for name, value in {
        **ENVIRONMENT,
        "AWS_ENDPOINT_URL": proxy.address,
        "ORTHOSWARM_CACHE": str(tmp_path / "cache"),
    }.items():
        monkeypatch.setenv(name, value)
    requests._file_systems.clear()
    configure({"stores": {"first_wait_s": 0.01, "timeout_s": 5.0}})
    yield proxy
    proxy.close()
    requests._file_systems.clear()


@pytest.fixture
def bucket(store, request):
    """A function that copies a folder into a new bucket and gives the address."""
    name = re.sub("[^a-z0-9]+", "-", request.node.name.lower())[:50].strip("-")

    def fill(folder=None):
        system = requests.file_system(path_of(f"s3://{name}"))
        system.mkdir(name)
        if folder is not None:
            system.put(f"{folder}/", f"{name}/site", recursive=True)
        return f"s3://{name}"

    return fill


def test_the_same_map_as_from_folders(bucket, site, tmp_path):
    address, local = bucket(site), tmp_path / "local"
    asked = ["--gsd", "0.5", "--workers", "1"]
    assert (
        main(["mosaic", str(site / "photos"), "--basemap", str(site / "before.tif"), "--out", str(local), *asked]) == 0
    )
    out = f"{address}/map"
    inputs = [f"{address}/site/photos", "--basemap", f"{address}/site/before.tif"]
    assert main(["mosaic", *inputs, "--out", out, *asked]) == 0
    for name in PRODUCTS:
        assert content(path_of(f"{out}/{name}")) == (local / name).read_bytes(), name
    report = json.loads(content(path_of(f"{out}/report.json")))
    assert report["root"] == f"{address}/site/photos" and report["basemap"] == f"{address}/site/before.tif"
    left = {path.name for path in list_folder(path_of(out))}
    assert left == {*PRODUCTS, "footprints.gpkg", "seamlines.gpkg", "report.json", "report.html"}
    assert not list((cache_folder() / "maps").glob("*"))  # nothing stays on this machine but copies


@pytest.fixture
def hasty(tmp_path):
    """A configuration for the command that repeats requests at once."""
    path = tmp_path / "hasty.toml"
    path.write_text("[stores]\nfirst_wait_s = 0.01\n")
    return str(path)


def test_photos_that_fail_are_left_out_and_the_others_mapped(bucket, store, site, tmp_path, hasty):
    address = bucket(site)
    bad = {"DJI_0001.JPG": 404, "DJI_0003.JPG": 500, "DJI_0005.JPG": 403}
    store.fault = lambda method, path: next((s for n, s in bad.items() if n in path and method == "GET"), None)
    out = tmp_path / "out"
    asked = ["--gsd", "0.5", "--workers", "1", "--config", hasty]
    assert main(["mosaic", f"{address}/site/photos", "--out", str(out), *asked]) == 0
    rows = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    reasons = {row["image"][-12:]: row["reason"] for row in rows if row["stage"] == "rejected"}
    assert set(reasons) == set(bad) and len(rows) == 10
    assert "is not there" in reasons["DJI_0001.JPG"] and "is refused by its store" in reasons["DJI_0005.JPG"]
    assert "failed in 5 attempts" in reasons["DJI_0003.JPG"]


def test_a_request_that_fails_now_and_then_is_repeated(bucket, store, site):
    address = bucket(site)
    failures = iter([500, 503, 0.05])
    store.fault = lambda method, path: next(failures, None) if "DJI_0000" in path and method == "GET" else None
    path = path_of(f"{address}/site/photos/a/DJI_0000.JPG")
    assert content(path) == (site / "photos" / "a" / "DJI_0000.JPG").read_bytes()
    assert sum("DJI_0000" in p and m == "GET" for m, p in store.seen) >= 3


def test_a_silent_store_is_given_up(bucket, store, site, configure):
    address = bucket(site)
    configure({"stores": {"first_wait_s": 0.01, "timeout_s": 0.3, "attempts": 2}})
    requests._file_systems.clear()
    store.fault = lambda method, path: 3.0
    with pytest.raises(StoreRequestError, match="in 2 attempts"):
        content(path_of(f"{address}/site/photos/a/DJI_0000.JPG"))


def test_a_store_that_is_gone_ends_the_run_in_one_sentence(store, monkeypatch, capsys, tmp_path, hasty):
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    requests._file_systems.clear()
    with pytest.raises(StoreLostError, match="cannot be reached"):
        content(path_of("s3://flood/a.jpg"))
    assert main(["mosaic", "s3://flood/photos", "--out", str(tmp_path / "out"), "--config", hasty]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["s3://absent-bucket/photos", "--out", "OUT"], "s3://absent-bucket/photos does not exist"),
        (["BUCKET/nothing", "--out", "OUT"], "does not exist"),
        (["PHOTOS", "--basemap", "BUCKET/no.tif", "--out", "OUT"], "no.tif does not exist"),
        (["PHOTOS", "--out", "s3://absent-bucket/map"], "cannot be written"),
        (["PHOTOS", "--out", "https://example.org/map"], "nothing can be written to https://example.org/map"),
    ],
)
def test_wrong_addresses_are_refused(bucket, site, tmp_path, capsys, arguments, text):
    values = {"BUCKET": bucket(), "PHOTOS": str(site / "photos"), "OUT": str(tmp_path / "out")}
    for name, value in values.items():
        arguments = [a.replace(name, value) for a in arguments]
    assert main(["mosaic", *arguments]) == 2
    said = capsys.readouterr().err.strip()
    assert text in said and len(said.splitlines()) == 1 and not (tmp_path / "out").exists()


def test_an_upload_that_fails_goes_on_and_the_report_comes_last(bucket, store, tmp_path):
    address = path_of(bucket()) / "map"
    out = PublishedFolder(address)
    out.local.mkdir(parents=True)
    for name in ("a.tif", "b.tif", "report.json"):
        (out.local / name).write_text(name)
    (out.local / ".work").mkdir()
    (out.local / ".work" / "key").write_text("")
    store.fault = lambda method, path: 500 if "b.tif" in path and method == "PUT" else None
    with pytest.raises(StoreRequestError):
        out.publish(["a.tif", "b.tif"])
    assert [p.name for p in list_folder(address)] == ["a.tif"]
    store.fault, store.seen = (lambda method, path: None), []
    PublishedFolder(address).publish(["a.tif", "b.tif"])
    put = [path for method, path in store.seen if method == "PUT" and "writable" not in path]
    assert [p.rpartition("/")[2] for p in put] == ["b.tif", "report.json"]
    assert not out.local.exists() and len(list_folder(address)) == 3


def test_products_of_an_earlier_run_are_removed_and_other_files_stay(bucket, tmp_path):
    address = path_of(bucket()) / "map"
    first = ("a.tif", "b.tif", "notes.txt", "tiles/a/r0.tif", "tiles/b/r0.tif", "report.json")
    for names in (first, ("a.tif", "tiles/a/r0.tif", "report.json")):
        out = PublishedFolder(address)
        for name in names:
            (out.local / name).parent.mkdir(parents=True, exist_ok=True)
            (out.local / name).write_text(name)
        out.publish(["a.tif", "b.tif", "tiles", "report.json"])
    left = [p.relative_to(address).as_posix() for p in list_folder(address)]
    assert left == ["a.tif", "notes.txt", "report.json", "tiles/a/r0.tif"]


def test_a_large_file_goes_up_in_parts(bucket, store, tmp_path, configure):
    configure({"stores": {"part_mb": 5}})
    address = path_of(bucket()) / "map"
    out = PublishedFolder(address)
    out.local.mkdir(parents=True)
    data = bytes(range(256)) * (12 << 12)  # 12.6 MB
    (out.local / "a.tif").write_bytes(data)
    failures = iter([503])
    store.fault = lambda method, path: next(failures, None) if "partNumber=2" in path else None
    out.publish(["a.tif"])
    assert sum("partNumber" in path for _, path in store.seen) >= 3
    assert content(address / "a.tif") == data


def test_tags_of_a_large_photo_are_read_from_its_ends(bucket, store, site, tmp_path, configure):
    from telemetry import load

    folder = tmp_path / "large"
    shutil.copytree(site / "photos", folder)
    for path in folder.rglob("*.JPG"):
        data = path.read_bytes()
        scan = data.index(b"\xff\xda")
        filler = b"".join(b"\xff\xfe\xff\xff" + bytes(65_533) for _ in range(10))  # comments, as makers' previews are
        path.write_bytes(data[:scan] + filler + data[scan:])
    address = bucket(folder)
    store.seen.clear()
    found = load([path_of(f"{address}/site")])
    assert [f.image for f in found.frames] == [f.image for f in load([folder]).frames]
    assert [f.fix for f in found.frames] == [f.fix for f in load([folder]).frames]
    assert not any((cache_folder() / "copies").glob("*/*.JPG"))


def test_tables_and_logs_in_a_store_are_used(bucket, tmp_path):
    from telemetry import load

    scene = Scene()
    scene.fly(tmp_path / "photos", legs(count=1, photos=3, tags="none"))
    names = sorted(p.name for p in (tmp_path / "photos").iterdir())
    lines = [f"{name} {8.5 + 1e-4 * i} 47.4 500" for i, name in enumerate(names)]
    (tmp_path / "photos" / "geo.txt").write_text("EPSG:4326\n" + "\n".join(lines) + "\n")
    address = bucket(tmp_path / "photos")
    found = load([path_of(f"{address}/site")])
    assert [f.fix for f in found.frames] == [f.fix for f in load([tmp_path / "photos"]).frames] and len(
        found.frames
    ) == 3


def test_the_cache_stays_within_its_size(bucket, site, configure):
    address = bucket(site)
    paths = [p for p in list_folder(path_of(address)) if p.suffix == ".JPG"]
    size = sum(len(content(p)) for p in paths)
    configure({"stores": {"cache_mb": size / 2 / 1e6, "held_s": 0.0}})
    clear_old_copies()
    left = list((cache_folder() / "copies").glob("*/*.JPG"))
    assert 0 < sum(p.stat().st_size for p in left) <= size / 2
    assert [len(content(p)) for p in paths]  # those that went are fetched again


def test_a_file_that_changed_in_its_store_is_fetched_again(bucket, configure):
    path = path_of(bucket()) / "a.txt"
    system = requests.file_system(path)
    system.pipe_file("/".join(path.parts[2:]), b"one")
    assert content(path) == b"one"
    system.pipe_file("/".join(path.parts[2:]), b"two")
    configure({"stores": {"cache_trust_s": 0.0}})
    assert content(path) == b"two" and content(path) == b"two"
    system.rm_file("/".join(path.parts[2:]))
    with pytest.raises(NotStoredError):
        local_file(path)


def test_missing_packages_are_named(monkeypatch, capsys, tmp_path):
    requests._file_systems.clear()
    for scheme in ("s3", "gs"):
        monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, scheme, raising=False)
    monkeypatch.setitem(sys.modules, "s3fs", None)
    assert main(["mosaic", "s3://flood/photos", "--out", str(tmp_path / "out")]) == 2
    assert "pip install orthoswarm[cloud]" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(InputError, match="pip install"):
        content(path_of("gs://flood/a.jpg"))
    assert active().stores.attempts == 5
