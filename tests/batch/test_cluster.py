"""A Dask cluster on loopback gives what the local workers give, and a worker that dies loses nothing."""

import hashlib
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("distributed", reason="needs the extra 'cluster'")

from orthoswarm.compute.dask_cluster import Cluster
from orthoswarm.compute.workers import Processes, Serial
from orthoswarm.model.errors import InputError, OrthoSwarmError

SMALL = {"DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "False", "OMP_NUM_THREADS": "1"}


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


class Loopback:
    """A scheduler and workers as processes of their own."""

    def __init__(self, folder: Path):
        self.file = folder / "scheduler.json"
        self.processes = []
        root = str(Path(__file__).resolve().parents[2])
        self.environment = {**os.environ, **SMALL, "PYTHONPATH": root}

    def begin(self, workers):
        self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        self.wait(self.file.exists)
        for _ in range(workers):
            self.worker()
        self.wait_for_workers(workers)

    def start(self, what, *args):
        command = [sys.executable, "-m", "dask", what, "--scheduler-file", str(self.file), *args]
        quiet = subprocess.DEVNULL
        self.processes.append(subprocess.Popen(command, env=self.environment, stdout=quiet, stderr=quiet))

    def worker(self):
        self.start("worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard")

    @property
    def address(self):
        import json

        return json.loads(self.file.read_text())["address"]

    def wait(self, ready, seconds=180):
        end = time.monotonic() + seconds
        while not ready():
            assert time.monotonic() < end, "the cluster did not start"
            time.sleep(0.1)

    def wait_for_workers(self, count):
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=180)

    def close(self):
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait(60)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


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


def test_a_wrong_address_is_one_sentence(configure):
    configure({"compute": {"cluster_connect_s": 0.5}})
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
    from orthoswarm.batch.pipeline import Options, run
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

            run(read, out, Options(basemap=basemap, gsd_m=0.5), pool, lambda *_: None)
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
