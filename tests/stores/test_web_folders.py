"""Photos on a web server: listed by a file of names or by index pages, and addresses as paths."""

import functools
import http.server
import threading
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.compute.workers import spawn_context
from orthoswarm.stores.addresses import address_of, is_stored, path_of
from orthoswarm.stores.local_copies import compare_from_now, content


@pytest.mark.parametrize(
    "address", ["s3://bucket", "s3://bucket/a/b c.jpg", "gs://bucket/ü/1.jpg", "https://example.org:8080/a/b.jpg"]
)
def test_an_address_is_a_path_and_back(address):
    path = path_of(address)
    assert is_stored(path) and address_of(path) == address
    assert address_of(path / "x.jpg") == f"{address}/x.jpg" and (path / "x.jpg").parent == path


@pytest.mark.parametrize("text", ["photos", "/photos", "C:/photos", "s3:/bucket", "file://x", "./s3:/b", "/s3/b"])
def test_other_names_are_local(text):
    assert path_of(text) == Path(text) and not is_stored(path_of(text)) and address_of(Path(text)) == str(Path(text))


@pytest.fixture
def web(tmp_path, monkeypatch):
    """A web server of the folder `tmp_path/www`; yields its address."""
    pytest.importorskip("fsspec", reason="needs the extra 'cloud'")
    pytest.importorskip("aiohttp", reason="needs the extra 'cloud'")
    monkeypatch.setenv("ORTHOSWARM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "www").mkdir()

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    handler = functools.partial(Quiet, directory=str(tmp_path / "www"))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture
def flight(tmp_path, web):
    from tests.kit.scene import Scene, legs

    scene, folder = Scene(), tmp_path / "www" / "my flight"
    scene.fly(folder / "a", legs(count=1, photos=3))
    scene.fly(folder / "b", legs(count=1, photos=2))
    return folder


def names(address):
    from telemetry import load

    return [frame.image for frame in load([path_of(address)]).frames]


def test_a_folder_is_listed_by_its_index_pages(flight, web):
    (flight.parent / "other").mkdir()
    (flight.parent / "other" / "x.jpg").write_bytes(b"")
    expected = [p.relative_to(flight).as_posix() for p in sorted(flight.rglob("*.JPG"))]
    assert names(f"{web}/my flight") == expected and len(expected) == 5


def test_a_file_of_names_comes_first_and_stays_below_its_folder(flight, web):
    first = next(flight.rglob("*.JPG")).relative_to(flight).as_posix()
    (flight / "files.txt").write_text(f"# photos\n{first}\n../other/x.jpg\n")
    assert names(f"{web}/my flight/") == [Path(first).as_posix()]


def test_what_is_not_there_is_one_sentence(web):
    from orthoswarm.model.errors import InputError

    with pytest.raises(InputError, match=r"http://127\.0\.0\.1.*/nothing does not exist"):
        names(f"{web}/nothing")


def test_an_address_of_a_browser_names_the_same_files(flight, web):
    assert names(f"{web}/my%20flight/") == names(f"{web}/my flight")
    assert names(f"{web}/my%20flight/a/DJI_0001.JPG") == ["DJI_0001.JPG"]
    assert len(names(web)) == 5  # a server is a folder, whatever its name ends with


@given(st.text(st.characters(blacklist_characters="/\\\0", blacklist_categories=("Cs",)), min_size=1))
def test_any_name_on_the_web_has_an_address(name):
    path = path_of("https://example.org/a") / name
    assert name in (".", "..") or path_of(address_of(path)) == path


def test_worker_processes_of_a_run_take_no_old_copy_either(web, tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOSWARM_COMPARE_FROM", "nonsense")  # which counts for nothing
    path, file = path_of(f"{web}/a.jpg"), tmp_path / "www" / "a.jpg"
    file.write_bytes(b"old")
    assert content(path) == b"old"
    file.write_bytes(b"another")
    assert content(path) == b"old"  # was compared a moment ago
    compare_from_now()
    with ProcessPoolExecutor(1, mp_context=spawn_context()) as pool:
        assert pool.submit(content, path).result() == b"another"
