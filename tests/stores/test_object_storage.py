"""Maps from and into servers of object storage on loopback: products as from folders, failures in one sentence."""

import json
import re
import shutil
import sys

import pytest

from gcs_plugin.cli.main import main
from orthoswarm.batch.run_state import is_written
from orthoswarm.model.errors import InputError
from orthoswarm.stores import local_copies, published_folder, requests
from orthoswarm.stores.addresses import path_of
from orthoswarm.stores.listing import list_folder
from orthoswarm.stores.local_copies import cache_folder, clear_old_copies, content, local_file
from orthoswarm.stores.published_folder import PublishedFolder
from orthoswarm.stores.requests import NotStoredError, StoreLostError, StoreRequestError
from tests.kit.scene import Scene, legs
from tests.kit.servers.ports import free_port
from tests.kit.servers.store_server import KINDS, FaultyProxy, store_server

REPORTS = ("report.json", "report.html")
PRODUCTS = ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl")
UPLOADS = ("PUT", "POST")


@pytest.fixture(scope="module", params=KINDS)
def server(request):
    """A server of each kind, and its address."""
    kind = KINDS[request.param]
    kind.require()
    with store_server(kind) as address:
        yield kind, address


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Photos of one vehicle and a map."""
    folder = tmp_path_factory.mktemp("site")
    scene = Scene()
    scene.fly(folder / "photos" / "a", legs(count=2, photos=5))
    scene.basemap(folder / "before.tif")
    return folder


@pytest.fixture
def store(server, monkeypatch, tmp_path):
    """A proxy before the server that this process uses, with an empty cache of its own; quick to give up."""
    kind, address = server
    proxy = FaultyProxy(address, kind)
    for name, value in {
        **kind.environment,
        kind.endpoint: proxy.address,
        "ORTHOSWARM_CACHE": str(tmp_path / "cache"),
    }.items():
        monkeypatch.setenv(name, value)
    requests._file_systems.clear()
    monkeypatch.setattr(requests, "_FIRST_WAIT_S", 0.01)
    yield proxy
    proxy.close()
    requests._file_systems.clear()


@pytest.fixture
def bucket(store, request):
    """A function that copies a folder into a new bucket and gives the address."""
    name = re.sub("[^a-z0-9]+", "-", request.node.name.lower())[:50].strip("-")

    def fill(folder=None):
        address = f"{store.kind.scheme}://{name}"
        system = requests.file_system(path_of(address))
        system.mkdir(name)
        if folder is not None:
            system.put(f"{folder}/", f"{name}/site", recursive=True)
        return address

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
    assert left == {*PRODUCTS, "footprints.gpkg", "seamlines.gpkg", "confidence.tif", "ground.tif", *REPORTS}
    assert not list((cache_folder() / "maps").glob("*"))  # nothing stays on this machine but copies


def test_photos_that_fail_are_left_out_and_the_others_mapped(bucket, store, site, tmp_path):
    address = bucket(site)
    bad = {"DJI_0001.JPG": 404, "DJI_0003.JPG": 500, "DJI_0005.JPG": 403}
    store.fault = lambda method, path: next((s for n, s in bad.items() if n in path and method == "GET"), None)
    out = tmp_path / "out"
    asked = ["--gsd", "0.5", "--workers", "1"]
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


def test_a_silent_store_is_given_up(bucket, store, site, monkeypatch):
    address = bucket(site)
    monkeypatch.setattr(requests, "_TIMEOUT_S", 1.0)
    monkeypatch.setattr(requests, "_ATTEMPTS", 2)
    requests._file_systems.clear()
    store.fault = lambda method, path: 20.0
    with pytest.raises(StoreRequestError, match="in 2 attempts"):
        content(path_of(f"{address}/site/photos/a/DJI_0000.JPG"))


def test_a_store_that_is_gone_ends_the_run_in_one_sentence(store, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv(store.kind.endpoint, f"http://127.0.0.1:{free_port()}")
    requests._file_systems.clear()
    flood = f"{store.kind.scheme}://flood"
    with pytest.raises(StoreLostError, match="cannot be reached"):
        content(path_of(f"{flood}/a.jpg"))
    assert main(["mosaic", f"{flood}/photos", "--out", str(tmp_path / "out")]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["ABSENT/photos", "--out", "OUT"], "://absent-bucket/photos does not exist"),
        (["BUCKET/nothing", "--out", "OUT"], "does not exist"),
        (["PHOTOS", "--basemap", "BUCKET/no.tif", "--out", "OUT"], "no.tif does not exist"),
        (["PHOTOS", "--out", "ABSENT/map"], "cannot be written"),
        (["PHOTOS", "--out", "https://example.org/map"], "nothing can be written to https://example.org/map"),
    ],
)
def test_wrong_addresses_are_refused(bucket, store, site, tmp_path, capsys, arguments, text):
    values = {"BUCKET": bucket(), "PHOTOS": str(site / "photos"), "OUT": str(tmp_path / "out")}
    values["ABSENT"] = f"{store.kind.scheme}://absent-bucket"
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
    store.fault = lambda method, path: 500 if "b.tif" in path and method in UPLOADS else None
    with pytest.raises(StoreRequestError):
        out.publish(lambda name: True)
    assert [p.name for p in list_folder(address)] == ["a.tif"]
    store.fault, store.seen = (lambda method, path: None), []
    PublishedFolder(address).publish(lambda name: True)
    put = [path for method, path in store.seen if method in UPLOADS and "writable" not in path]
    assert [p.rpartition("/")[2] for p in put] == ["b.tif", "report.json"]
    assert [p.name for p in out.local.iterdir()] == [".work"] and len(list_folder(address)) == 3


def test_products_of_an_earlier_run_are_removed_and_other_files_stay(bucket, tmp_path):
    address = path_of(bucket()) / "map"
    tiles = ("tiles/a/r000_c000.tif", "tiles/b/r000_c000.tif", "tiles/collection.json", "tiles/vehicles/uav01.json")
    others = ("notes.txt", "tiles/12/2200/1343.png", "tiles/notes.txt", "tiles/vehicles/plan/a.json")
    first = ("coarse.tif", "realtime.tif", *tiles, *others, "report.json")
    for names in (first, ("realtime.tif", tiles[0], "report.json")):
        out = PublishedFolder(address)
        for name in names:
            (out.local / name).parent.mkdir(parents=True, exist_ok=True)
            (out.local / name).write_text(name)
        out.publish(is_written)
    left = [p.relative_to(address).as_posix() for p in list_folder(address)]
    assert left == sorted(["realtime.tif", "report.json", tiles[0], *others])


def test_a_large_file_goes_up_in_parts(bucket, store, tmp_path, monkeypatch):
    monkeypatch.setattr(published_folder, "_PART_BYTES", 5 << 20)
    address = path_of(bucket()) / "map"
    out = PublishedFolder(address)
    out.local.mkdir(parents=True)
    data = bytes(range(256)) * (12 << 12)  # 12.6 MB
    (out.local / "a.tif").write_bytes(data)
    answers = iter([None, 503])
    store.fault = lambda method, path: next(answers, None) if store.kind.part in path else None
    out.publish(is_written)
    assert sum(store.kind.part in path for method, path in store.seen if method in UPLOADS) >= 4
    assert content(address / "a.tif") == data


def test_tags_of_a_large_photo_are_read_from_its_ends(bucket, store, site, tmp_path):
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


def test_the_cache_stays_within_its_size(bucket, site, monkeypatch):
    address = bucket(site)
    paths = [p for p in list_folder(path_of(address)) if p.suffix == ".JPG"]
    size = sum(len(content(p)) for p in paths)
    monkeypatch.setenv("ORTHOSWARM_CACHE_MB", str(size / 2 / 1e6))
    monkeypatch.setattr(local_copies, "_HELD_S", 0.0)
    clear_old_copies()
    left = list((cache_folder() / "copies").glob("*/*.JPG"))
    assert 0 < sum(p.stat().st_size for p in left) <= size / 2
    assert [len(content(p)) for p in paths]  # those that went are fetched again


def test_a_size_of_the_cache_that_is_none_is_refused_before_the_run(tmp_path, monkeypatch, capsys):
    for said in ("much", "-1", "nan"):
        monkeypatch.setenv("ORTHOSWARM_CACHE_MB", said)
        assert main(["mosaic", "s3://flood/photos", "--out", str(tmp_path / "out")]) == 2
        assert f"ORTHOSWARM_CACHE_MB is {said}, which is no size; give megabytes" in capsys.readouterr().err


def test_a_file_that_changed_in_its_store_is_fetched_again(bucket, monkeypatch):
    path = path_of(bucket()) / "a.txt"
    system = requests.file_system(path)
    system.pipe_file("/".join(path.parts[2:]), b"one")
    assert content(path) == b"one"
    system.pipe_file("/".join(path.parts[2:]), b"two")
    monkeypatch.setattr(local_copies, "_TRUST_S", 0.0)
    assert content(path) == b"two" and content(path) == b"two"
    system.rm_file("/".join(path.parts[2:]))
    with pytest.raises(NotStoredError):
        local_file(path)


def test_files_with_any_name_and_end_arrive_whole(bucket, store):
    address = path_of(bucket()) / "map"
    out = PublishedFolder(address)
    files = {"a#1 50%.tif": b"a\r\n", "ü{0}.tif": b"b\r", "[c]?.tif": b"", "d.json": b"{}\n"}
    out.local.mkdir(parents=True)
    for name, data in files.items():
        (out.local / name).write_bytes(data)
    requests.file_system(address).pipe_file(
        "/".join([*address.parts[2:], ""]), b""
    )  # as store's own pages make folders
    out.publish(is_written)
    assert {p.name: content(p) for p in list_folder(address)} == files


def test_a_file_that_was_listed_comes_in_one_request(bucket, store, site):
    path = list_folder(path_of(bucket(site)) / "site" / "photos")[0]
    store.seen.clear()
    assert content(path) and len(store.seen) == 1


@pytest.mark.parametrize("server", ["gs"], indirect=True)
def test_requests_without_credentials_that_need_them_say_so(bucket, store, site, tmp_path, capsys):
    photos = f"{bucket(site)}/site/photos"
    store.fault = lambda method, path: 401
    assert main(["mosaic", photos, "--out", str(tmp_path / "out")]) == 2
    assert f"there are no credentials for {photos}" in capsys.readouterr().err


@pytest.mark.parametrize("server", ["gs"], indirect=True)
@pytest.mark.parametrize(("answers", "failure"), [(True, InputError), (False, StoreLostError)])
def test_a_login_that_ended_is_told_from_a_lost_network(store, monkeypatch, tmp_path, answers, failure):
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    key = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()).decode()
    token = f"{store.address}/token" if answers else f"http://127.0.0.1:{free_port()}/token"
    account = {"type": "service_account", "project_id": "flood", "private_key_id": "1", "private_key": pem}
    account |= {"client_email": "a@flood.example", "client_id": "1", "token_uri": token}
    (tmp_path / "account.json").write_text(json.dumps(account))
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", str(tmp_path / "account.json"))
    store.fault = lambda method, path: 400 if path == "/token" else None
    with pytest.raises(failure):
        content(path_of("gs://flood/a.jpg"))
    assert not answers or any(path == "/token" for _, path in store.seen)


def test_missing_packages_are_named(monkeypatch, capsys, tmp_path):
    requests._file_systems.clear()
    registry = pytest.importorskip("fsspec.registry", reason="needs the extra 'cloud'")
    monkeypatch.delitem(registry._registry, "s3", raising=False)
    monkeypatch.delitem(sys.modules, "orthoswarm.stores.google_store", raising=False)
    for scheme, package in (("s3", "s3fs"), ("gs", "gcsfs")):
        for name in [package, *(name for name in sys.modules if name.startswith(f"{package}."))]:
            monkeypatch.setitem(sys.modules, name, None)
        assert main(["mosaic", f"{scheme}://flood/photos", "--out", str(tmp_path / "out")]) == 2
        assert f"needs the package {package}; pip install orthoswarm[cloud]" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(InputError, match="pip install"):
        content(path_of("gs://flood/a.jpg"))
