"""A Dask cluster on loopback gives what the local workers give, and a worker that dies loses nothing."""

import gc
import hashlib
import os
import shutil
import subprocess
import time
import warnings
from functools import partial

import numpy as np
import pytest

pytest.importorskip("distributed", reason="needs the extra 'cluster'")

from orthoswarm.compute import dask_cluster
from orthoswarm.compute.dask_cluster import Cluster, ClusterLostError
from orthoswarm.compute.workers import Processes, Serial
from orthoswarm.model.errors import InputError, OrthoSwarmError
from tests.kit.servers.loopback_cluster import SMALL, Loopback


@pytest.fixture(autouse=True)
def _no_sockets_left_for_other_tests():
    """Connections to a killed scheduler are left to the garbage collector, whose warning would hit any other test."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def squares(n):
    return {"n": n * n, "row": np.full(3, n)}


def refuse(n):
    if n == 3:
        raise ValueError("three")
    return n


def grow(numbers):
    numbers.append(1)
    return len(numbers)


def die_once(marker, n):
    """The first worker that gets here dies."""
    if n == 5:
        try:
            os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return n
        os._exit(9)
    return n


def die(_):
    os._exit(9)


@pytest.fixture(scope="module")
def loopback(tmp_path_factory):
    """A scheduler with two workers."""
    with Loopback(tmp_path_factory.mktemp("cluster")) as both:
        both.begin(2)
        yield both


def test_results_are_those_of_local_workers_in_order(loopback):
    with Cluster(loopback.address) as cluster:
        assert cluster.count == 2
        found = list(cluster.map(squares, iter(range(30))))
        assert list(cluster.map(squares, [])) == []
        used = cluster.usage()
    expected = list(Serial().map(squares, range(30)))
    assert [f["n"] for f in found] == [e["n"] for e in expected]
    assert all((f["row"] == e["row"]).all() for f, e in zip(found, expected, strict=True))
    assert used.peak_rss_mb > 20 and used.cpu_s >= 0


def test_items_are_copies_and_errors_come_at_their_turn(loopback):
    shared = [0]
    with Cluster(loopback.address) as cluster:
        assert list(cluster.map(grow, [shared] * 5)) == [2] * 5
        results = cluster.map(refuse, range(8))
        assert [next(results) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(ValueError, match="three"):
            next(results)
    assert shared == [0]


def test_a_path_that_workers_do_not_see_is_refused(loopback, tmp_path):
    with Cluster(loopback.address, [tmp_path]):
        pass
    with pytest.raises(InputError, match=r"does not see .*missing"):
        Cluster(loopback.address, [tmp_path / "missing"])


@pytest.mark.parametrize("empty", ["photos", "out"])
def test_a_worker_without_the_shared_folder_mounted_is_refused(tmp_path, empty):
    for name in ("photos/a", "out", "nothing"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "photos" / "a" / "DJI_0001.JPG").write_bytes(b"a photo")
    apart = ["unshare", "--map-root-user", "--mount", "sh", "-c", 'mount --bind "$0" "$1" && shift && exec "$@"']
    apart += [str(tmp_path / "nothing"), str(tmp_path / empty)]
    if shutil.which("unshare") is None or subprocess.run([*apart, "true"], capture_output=True).returncode:
        pytest.skip("needs a system on which a process may have mounts of its own")
    with Loopback(tmp_path) as one:
        one.begin(1)
        Cluster(one.address, [tmp_path / "photos"], written=tmp_path / "out").close()
        one.worker(*apart)
        one.wait_for_workers(2)
        with pytest.raises(InputError, match=rf"does not see .*{empty}"):
            Cluster(one.address, [tmp_path / "photos"], written=tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_wrong_address_is_one_sentence(monkeypatch):
    monkeypatch.setattr(dask_cluster, "_CONNECT_S", 0.5)
    with pytest.raises(InputError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        Cluster("tcp://127.0.0.1:9")
    for address in ("nonsense:::", "scheduler", "tcp://10.0.0.1"):
        with pytest.raises(InputError, match="is not an address of a Dask scheduler"):
            Cluster(address)


def test_a_worker_that_would_sum_differently_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(SMALL, "OMP_NUM_THREADS", "2")
    with Loopback(tmp_path) as one:
        one.begin(1)
        with pytest.raises(InputError, match="several threads"):
            Cluster(one.address)


def test_the_same_map_as_with_local_workers(loopback, tmp_path):
    from orthoswarm.batch.pipeline import run
    from orthoswarm.batch.run_state import MapOptions
    from telemetry import LoadOptions, load
    from tests.kit.scene import Scene, legs

    scene = Scene()
    scene.fly(tmp_path / "photos" / "a", legs(count=2, photos=5))
    basemap = scene.basemap(tmp_path / "map.tif")
    sums = []
    with Cluster(loopback.address, [tmp_path]) as cluster, Processes(1) as local:
        for name, pool in (("local", local), ("cluster", cluster)):
            out = tmp_path / name

            def read(tell, out=out):
                return load([tmp_path / "photos"], progress=tell, options=LoadOptions(exclude=(out,)))

            run(read, out, MapOptions(basemap=basemap, gsd_m=0.5), pool, lambda *_: None)
            files = [out / n for n in ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl")]
            sums.append([hashlib.sha256(f.read_bytes()).hexdigest() for f in files])
    assert sums[0] == sums[1]


def test_a_worker_that_dies_in_the_middle_loses_nothing(tmp_path):
    with Loopback(tmp_path) as both:
        both.begin(2)
        with Cluster(both.address, patience_s=1.0) as cluster:
            assert list(cluster.map(partial(die_once, str(tmp_path / "died")), range(12))) == list(range(12))
            assert (tmp_path / "died").exists() and cluster.count == 1
            with pytest.raises(OrthoSwarmError, match="all workers of the cluster are gone"):
                list(cluster.map(die, [0]))


def mark(folder):
    """Notes that this worker has begun."""
    with (folder / f"begun-{os.getpid()}").open("a") as file:
        file.write("x")


def has_begun(folder, _):
    time.sleep(0.05)
    return os.getpid(), (folder / f"begun-{os.getpid()}").exists()


def test_every_worker_begins_before_its_first_task_also_one_that_comes_later(tmp_path):
    with Loopback(tmp_path) as both:
        both.begin(1)
        with Cluster(both.address, begin=partial(mark, tmp_path)) as cluster:
            both.worker()
            both.wait_for_workers(2)
            found = list(cluster.map(partial(has_begun, tmp_path), range(40)))
    assert len({process for process, _ in found}) == 2 and all(begun for _, begun in found)
    assert [path.read_text() for path in tmp_path.glob("begun-*")] == ["x", "x"]


def slowly(folder, n):
    """Marks that it has begun and takes a moment."""
    (folder / f"begun-{n}").touch()
    time.sleep(0.1)
    return n * n


def test_a_scheduler_that_dies_and_comes_back_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(dask_cluster, "_CONNECT_S", 30.0)
    monkeypatch.setattr(dask_cluster, "_POLL_S", 0.2)
    with Loopback(tmp_path) as both:
        both.begin(1)
        with Cluster(both.address, patience_s=120.0) as cluster:
            results = cluster.map(partial(slowly, tmp_path), range(40))
            found = [next(results) for _ in range(10)]
            for process in list(both.processes):
                process.kill()
                process.wait(60)
            both.scheduler()
            both.worker()
            found += list(results)
    assert found == [n * n for n in range(40)]


def test_a_scheduler_that_stays_away_is_one_sentence(tmp_path, monkeypatch):
    with Loopback(tmp_path) as both:
        both.begin(1)
        with Cluster(both.address, patience_s=1.0) as cluster:
            monkeypatch.setattr(dask_cluster, "_CONNECT_S", 0.5)  # once it is connected
            monkeypatch.setattr(dask_cluster, "_POLL_S", 0.2)
            results = cluster.map(partial(slowly, tmp_path), range(40))
            next(results)
            both.close()
            with pytest.raises(ClusterLostError, match="run the same command again"):
                list(results)


def test_a_run_whose_cluster_is_lost_keeps_finished_flights(tmp_path):
    from orthoswarm.batch.pipeline import run
    from orthoswarm.batch.run_state import MapOptions
    from telemetry import load
    from tests.kit.scene import Scene, legs

    scene = Scene()
    for vehicle in "ab":
        scene.fly(tmp_path / "photos" / vehicle, legs(count=2, photos=5))

    def read(_):
        return load([tmp_path / "photos"])

    class Watched(Serial):
        """Counts the flights of the first pass; its cluster may be lost once one of them is done."""

        def __init__(self, last=None):
            self.last, self.flights = last, 0

        def map(self, function, items):
            for item in items:
                if getattr(function, "func", function).__name__ == "refine_tracked":
                    self.flights += 1
                if self.last is not None and self.last.exists():
                    raise ClusterLostError("gone")
                yield from super().map(function, [item])

    whole, lost, again = Watched(), Watched(tmp_path / "out" / ".work" / "vehicle-1-0.pickle"), Watched()
    run(read, tmp_path / "whole", MapOptions(gsd_m=0.5), whole, lambda *_: None)
    with pytest.raises(ClusterLostError):
        run(read, tmp_path / "out", MapOptions(gsd_m=0.5), lost, lambda *_: None)
    assert lost.last.exists()
    report = run(read, tmp_path / "out", MapOptions(gsd_m=0.5), again, lambda *_: None)
    assert again.flights == whole.flights - 1 and any("was continued" in text for text in report["warnings"])
    for name in ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
