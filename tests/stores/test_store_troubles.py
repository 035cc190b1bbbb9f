"""What concerns a whole store is not taken for the fault of one photo; no old copy counts; no work is lost."""

import json
import signal
import threading
from uuid import uuid4

import pytest

from gcs_plugin.cli.main import main
from orthoswarm.batch.refiners import REFINERS
from orthoswarm.model.errors import RunInterruptedError
from orthoswarm.stores import local_copies, ranges, requests
from orthoswarm.stores.addresses import path_of
from orthoswarm.stores.listing import list_folder, look_up
from orthoswarm.stores.local_copies import CacheFullError, cache_folder, content
from orthoswarm.stores.published_folder import PublishedFolder
from orthoswarm.stores.requests import StoreAccessError, StoreLostError
from tests.kit.scene import Scene, legs
from tests.kit.servers.store_server import S3, FaultyProxy, store_server

EXPIRED = b"<Error><Code>ExpiredToken</Code><Message>The provided token has expired.</Message></Error>"
QUICK = ["--gsd", "0.5", "--workers", "1", "--until", "coarse"]


@pytest.fixture(scope="module")
def server():
    S3.require()
    with store_server(S3) as address:
        yield address


@pytest.fixture
def store(server, monkeypatch, tmp_path):
    """A proxy before the server, with an empty cache."""
    proxy = FaultyProxy(server, S3)
    cache = {S3.endpoint: proxy.address, "ORTHOSWARM_CACHE": str(tmp_path / "cache")}
    for name, value in {**S3.environment, **cache}.items():
        monkeypatch.setenv(name, value)
    requests._file_systems.clear()
    monkeypatch.setattr(requests, "_FIRST_WAIT_S", 0.01)
    yield proxy
    proxy.close()
    requests._file_systems.clear()


@pytest.fixture
def photos(store, tmp_path):
    """Address of the photos of one vehicle, in a bucket of their own."""
    Scene().fly(tmp_path / "photos" / "a", legs(count=2, photos=5))
    bucket = f"bucket-{uuid4().hex}"
    system = requests.file_system(path_of("s3://x"))
    system.mkdir(bucket)
    system.put(f"{tmp_path / 'photos'}/", f"{bucket}/photos", recursive=True)
    return f"s3://{bucket}/photos"


@pytest.fixture
def hasty(monkeypatch):
    """Gives up soon on a store that is busy."""
    monkeypatch.setattr(requests, "_BUSY_S", 0.5)


def after(requests_count, fault):
    """A fault of all requests for photos after so many."""
    asked = []

    def answer(method, path):
        if "DJI_" in path and method == "GET":
            asked.append(path)
        return fault if len(asked) > requests_count else None

    return answer


@pytest.mark.parametrize(
    ("fault", "code", "said"),
    [
        ((400, EXPIRED), 2, "is no longer valid; log in again"),
        (503, 1, "has too much to do (status 503)"),
        (429, 1, "has too much to do (status 429)"),
    ],
)
def test_what_concerns_all_photos_ends_the_run_which_goes_on(store, photos, tmp_path, capsys, hasty, fault, code, said):
    command = ["mosaic", photos, "--out", str(tmp_path / "out"), *QUICK]
    store.fault = after(5, fault)
    assert main(command) == code
    assert said in capsys.readouterr().err
    store.fault = lambda method, path: None
    assert main(command) == 0
    assert json.loads((tmp_path / "out" / "report.json").read_text())["frames"]["used"] == 10


def test_a_store_that_has_too_much_to_do_for_a_moment_is_waited_for(store, photos, monkeypatch):
    failures = iter([503, 429] * 6)
    store.fault = lambda method, path: next(failures, None) if method == "GET" else None
    assert content(path_of(f"{photos}/a/DJI_0000.JPG"))
    monkeypatch.setattr(requests, "_BUSY_S", 0.1)
    store.fault = lambda method, path: 503
    with pytest.raises(StoreLostError, match="too much to do"):
        content(path_of(f"{photos}/a/DJI_0001.JPG"))


def test_a_cache_without_room_ends_the_run(store, photos, tmp_path, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "parts").write_text("")  # in the place of the folder that copies begin in
    monkeypatch.setenv("ORTHOSWARM_CACHE", str(tmp_path / "full"))
    with pytest.raises(CacheFullError, match="ORTHOSWARM_CACHE") as caught:
        content(path_of(f"{photos}/a/DJI_0000.JPG"))
    assert isinstance(caught.value, RunInterruptedError)


@pytest.mark.parametrize("whole_bytes", [0, 512 * 1024])
def test_photos_and_a_map_that_were_replaced_are_not_taken_from_the_cache(
    store, photos, tmp_path, monkeypatch, whole_bytes
):
    monkeypatch.setattr(ranges, "_WHOLE_BYTES", whole_bytes)
    system = requests.file_system(path_of(photos))
    assert main(["mosaic", photos, "--out", str(tmp_path / "first"), *QUICK]) == 0
    Scene(seed=5).fly(tmp_path / "photos" / "a", legs(count=2, photos=5))
    system.put(f"{tmp_path / 'photos'}/", photos.removeprefix("s3://"), recursive=True)
    assert main(["mosaic", photos, "--out", str(tmp_path / "second"), *QUICK]) == 0
    assert main(["mosaic", str(tmp_path / "photos"), "--out", str(tmp_path / "local"), *QUICK]) == 0
    first, second, local = ((tmp_path / out / "coarse.tif").read_bytes() for out in ("first", "second", "local"))
    assert first != second and second == local


def test_another_process_compares_a_copy_that_a_listing_contradicts(store, photos):
    path, key = path_of(f"{photos}/a/DJI_0000.JPG"), f"{photos.removeprefix('s3://')}/a/DJI_0000.JPG"
    content(path)
    requests.file_system(path).pipe_file(key, b"another")
    found = local_copies.look_up(path)
    local_copies.expect({path: found})
    assert content(path) == b"another"
    store.seen.clear()
    local_copies.compare_from_now()
    local_copies.expect({path: found})
    assert content(path) == b"another" and not store.seen  # the listing was the comparison


def test_an_upload_that_fails_is_repeated_without_the_work_and_holds_the_folder(store, photos, tmp_path, capsys, hasty):
    out = f"{photos.rpartition('/')[0]}/my map"
    command = ["mosaic", photos, "--out", out, "--tiles", "yes", *QUICK]
    others = []

    def fault(method, path):
        if "report.html" in path and method == "PUT":
            if not others:
                others.append(main([*command, "--no-gains"]))
            return 500
        return None

    store.fault = fault
    assert main(command) == 1 and others == [2]
    assert "another run is writing to" in capsys.readouterr().err
    store.fault, store.seen = (lambda method, path: None), []
    assert main(command) == 0
    put = {path.rpartition("/")[2] for method, path in store.seen if method == "PUT"}
    assert "r000_c000.tif" not in put and {"report.html", "report.json"} <= put
    assert "drawing" not in capsys.readouterr().err
    assert json.loads(content(path_of(f"{out}/tiles/collection.json")))["id"] == "my-map"
    assert not list((cache_folder() / "maps").glob("*"))


@pytest.mark.parametrize("where", ["while it waits", "while it tells how far it is"])
def test_an_upload_that_is_interrupted_ends_after_the_files_under_way(store, photos, tmp_path, where):
    out = PublishedFolder(path_of(f"{photos.rpartition('/')[0]}/map"))
    out.local.mkdir(parents=True)
    for number in range(200):
        (out.local / f"{number:03d}.tif").write_text("")
    store.seen = []
    interrupted = threading.Event()

    def fault(method, path):
        if where == "while it waits" and method == "PUT" and path.endswith("/020.tif"):
            interrupted.set()
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        return 1.0 if interrupted.is_set() else 0.05  # a busy machine may take a while to notice

    def told(*_):
        if where != "while it waits":
            interrupted.set()
            raise KeyboardInterrupt

    store.fault = fault
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            out.publish(lambda name: True, told)
    finally:
        signal.signal(signal.SIGINT, handler)
    sent = len([method for method, _ in store.seen if method == "PUT"])
    assert 0 < sent < 100
    store.fault = lambda method, path: None
    out.publish(lambda name: True)
    assert len(list_folder(out.address)) == 200


def test_a_fault_in_the_refinement_leaves_the_published_map_as_it_is(store, photos, tmp_path, monkeypatch, capsys):
    class Faulty:
        """A refiner with a bug."""

        def refine_batch(self, *_):
            raise ZeroDivisionError("by a bug")

    address = path_of(f"{photos.rpartition('/')[0]}/map")
    command = ["mosaic", photos, "--out", f"{photos.rpartition('/')[0]}/map", "--gsd", "0.5", "--workers", "1"]
    assert main(command) == 0
    before = {path: look_up(path) for path in list_folder(address)}
    assert address / "orthoimage.tif" in before
    with monkeypatch.context() as patched:
        patched.setitem(REFINERS, "swarm", lambda *_: Faulty())
        assert main(command) == 1
    (local,) = (cache_folder() / "maps").glob("*/map")
    said = capsys.readouterr().err
    assert f"{local / 'realtime.tif'} stands, but there is no orthoimage, and nothing was uploaded" in said
    assert (local / "realtime.tif").exists() and (local / "report.html").exists()
    assert {path: look_up(path) for path in list_folder(address)} == before
    assert main(command) == 0
    assert set(list_folder(address)) == set(before) and not local.exists()


def test_a_refused_store_is_not_called_absent(store, photos, tmp_path, capsys):
    store.fault = lambda method, path: 403
    assert main(["mosaic", photos, "--out", str(tmp_path / "out")]) == 2
    assert f"{photos} is refused by its store" in capsys.readouterr().err
    store.fault = lambda method, path: (403, EXPIRED.replace(b"ExpiredToken", b"InvalidAccessKeyId"))
    with pytest.raises(StoreAccessError, match="log in again"):
        list_folder(path_of(photos))


@pytest.mark.parametrize("flag", ["--surface", "--control", "--checkpoints"])
def test_files_that_have_to_lie_here_are_not_taken_from_an_address(photos, tmp_path, capsys, flag):
    assert main(["mosaic", photos, "--out", str(tmp_path / "out"), flag, "s3://flood/a.tif"]) == 2
    assert f"{flag} s3://flood/a.tif is an address; name a file on this machine" in capsys.readouterr().err


def test_the_map_may_lie_above_its_photos_and_inspect_reads_addresses(photos, capsys):
    bucket = photos.rpartition("/")[0]
    assert main(["inspect", photos, "--json", "--no-pictures"]) == 0
    assert json.loads(capsys.readouterr().out)["sources"][0]["counts"]["frames"] == 10
    assert main(["mosaic", photos, "--out", bucket, *QUICK]) == 0
    assert content(path_of(f"{bucket}/coarse.tif"))
