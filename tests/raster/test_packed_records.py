"""Records that processes of a run hand each other through the disk."""

import multiprocessing
import os
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.raster.packed_records import PackedRecords


def content(number: int, size: int = 1000) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, size, dtype=np.uint8)


def names(count: int) -> list[Path]:
    return [Path(f"/photos/{number}.jpg") for number in range(count)]


def _write(folder: Path, first: int, count: int) -> None:
    store = PackedRecords(folder)
    for number, name in list(enumerate(names(first + count)))[first:]:
        store.put(name, content(number))


@given(st.lists(st.lists(st.integers(0, 300), min_size=1, max_size=3), min_size=1, max_size=8))
def test_what_was_put_comes_out_in_this_and_another_reader(tmp_path_factory: pytest.TempPathFactory, sizes) -> None:
    folder = tmp_path_factory.mktemp("packed")
    writer, reader = PackedRecords(folder), PackedRecords(folder)
    for number, (name, parts) in enumerate(zip(names(len(sizes)), sizes, strict=True)):
        assert name not in reader
        arrays = [content(number + 100 * k, size) for k, size in enumerate(parts)]
        writer.put(name, *arrays)
        for store in (writer, reader):
            np.testing.assert_array_equal(store.get(name), np.concatenate(arrays))


def test_processes_find_each_others_records_in_one_file_each(tmp_path: Path) -> None:
    store = PackedRecords(tmp_path)
    workers = [
        multiprocessing.get_context("spawn").Process(target=_write, args=(tmp_path, 40 * k, 40)) for k in range(2)
    ]
    for worker in workers:
        worker.start()
    while any(worker.is_alive() for worker in workers):
        for number, name in enumerate(names(80)):  # read while they write: whole records or none
            got = store.get(name)
            assert got is None or np.array_equal(got, content(number))
    for worker in workers:
        worker.join()
    assert all(np.array_equal(store.get(name), content(number)) for number, name in enumerate(names(80)))
    assert len(list(tmp_path.iterdir())) == 2


def test_a_forked_process_writes_a_file_of_its_own(tmp_path: Path) -> None:
    store = PackedRecords(tmp_path)
    first, second, third = names(3)
    store.put(first, content(0))
    child = os.fork()
    if child == 0:
        store.put(second, content(1))
        os._exit(0)
    os.waitpid(child, 0)
    store.put(third, content(2))
    assert [np.array_equal(store.get(name), content(number)) for number, name in enumerate(names(3))] == [True] * 3


def test_a_record_that_a_killed_process_left_unfinished_counts_as_none(tmp_path: Path) -> None:
    _write(tmp_path, 0, 3)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for left in (len(whole) - 1, len(whole) - 999, len(whole) - 1010):
        file.write_bytes(whole[:left])
        store = PackedRecords(tmp_path)
        assert [name in store for name in names(3)] == [True, True, False]
        store.put(names(3)[2], content(2))
        np.testing.assert_array_equal(PackedRecords(tmp_path).get(names(3)[2]), content(2))
        (added,) = set(tmp_path.iterdir()) - {file}
        added.unlink()


def test_a_file_that_shrinks_or_goes_loses_its_records_only(tmp_path: Path) -> None:
    store, other = PackedRecords(tmp_path), names(2)[1]
    store.put(names(1)[0], content(0))
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:500])
    assert store.get(names(1)[0]) is None
    store.put(other, content(1))
    np.testing.assert_array_equal(store.get(other), content(1))
    np.testing.assert_array_equal(PackedRecords(tmp_path).get(other), content(1))
    shutil.rmtree(tmp_path)
    assert store.get(other) is None
    store.put(other, content(1))
    assert not tmp_path.exists()
    tmp_path.mkdir()
    store.put(other, content(1))
    np.testing.assert_array_equal(store.get(other), content(1))


def _write_on_a_full_disk(folder: Path) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, resource.RLIM_INFINITY))
    _write(folder, 0, 10)
    store = PackedRecords(folder)
    assert [name in store for name in names(10)] == [True] * 4 + [False] * 6
    store.put(Path("small"), content(1, 10))
    assert Path("small") in store


def test_what_does_not_fit_on_the_disk_leaves_the_rest_whole(tmp_path: Path) -> None:
    worker = multiprocessing.get_context("spawn").Process(target=_write_on_a_full_disk, args=(tmp_path,))
    worker.start()
    worker.join()
    assert worker.exitcode == 0
    store = PackedRecords(tmp_path)
    assert all(np.array_equal(store.get(name), content(number)) for number, name in enumerate(names(4)))
