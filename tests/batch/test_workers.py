"""Work gives the same results, in the same order, whatever the number of workers."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from orthoswarm.compute.threads import on_threads
from orthoswarm.compute.workers import Processes, Serial, cores, peak_rss_mb, prepare_process, workers
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.task_runner import Continued, serial


def square(n):
    time.sleep(0.002 * (n % 3))  # later items overtake earlier ones
    return n * n


def grow(numbers):
    numbers.append(1)
    return len(numbers) - 1


def identity(item):
    return item


def where(_):
    end = time.perf_counter() + 0.05
    while time.perf_counter() < end:
        pass
    return os.getpid()


def threads(_):
    import cv2

    return os.environ["OMP_NUM_THREADS"], cv2.getNumThreads()


def refuse(n):
    if n == 3:
        raise ValueError("three")
    return n


def die(n):
    if n >= 0:
        os._exit(9)


def test_results_do_not_depend_on_the_number_of_workers():
    items = list(range(40))
    expected = [n * n for n in items]
    assert list(Serial().map(square, items)) == expected
    with Processes(3) as three:
        assert list(three.map(square, iter(items))) == expected
        assert list(three.map(square, [])) == []


def halved(n):
    """Its second half tells in which process each half ran."""
    return Continued(second_half, (n, where(n)))


def second_half(item):
    n, first = item
    if n == 3:
        raise ValueError("three")
    return n, first, where(n)


def test_tasks_in_halves_give_the_same_results_in_order():
    items = list(range(40, 50))
    numbers = [n for n, _, _ in Serial().map(halved, items)]
    assert numbers == items == [n for n, _, _ in serial(halved, items)]
    for count in (1, 2, 3):
        with Processes(count) as pool:
            assert [n for n, _, _ in pool.map(halved, iter(items))] == items
            assert [n for n, _, _ in pool.map(halved, [40])] == [40]


def test_a_second_half_runs_where_a_process_is_free():
    with Processes(2) as pool:
        list(pool.map(where, range(2)))  # started
        assert any(first != second for _, first, second in pool.map(halved, [0, 1, 2]))


def test_tasks_are_halved_only_where_processes_would_be_idle():
    with Processes(2) as pool:
        list(pool.map(where, range(2)))  # started
        for items in ([0, 1], [0, 1, 2, 4, 5, 6, 7, 8]):
            assert all(first == second for _, first, second in pool.map(halved, items))


def test_an_error_in_the_second_half_comes_at_its_items_turn():
    with Processes(2) as pool:
        results = pool.map(halved, [0, 1, 3, 4])
        assert [next(results)[0] for _ in range(2)] == [0, 1]
        with pytest.raises(ValueError, match="three"):
            next(results)


def test_a_function_changes_a_copy_of_its_own():
    shared = [0]
    for count in (1, 2):
        with Processes(count) as some:
            assert list(some.map(grow, [shared] * 6)) == [1] * 6
    assert list(Serial().map(grow, [shared] * 3)) == [1] * 3 and shared == [0]


def test_a_copy_has_the_same_frames_and_its_own_arrays():
    frame = Frame(image="a.jpg", path=Path("a.jpg"), vehicle="uav01", time_s=None, fix=Fix(1.0, 2.0), width=4, height=3)
    given = [frame, frame], np.zeros(3)
    ((frames, array),) = Serial().map(identity, [given])
    assert frames is not given[0] and all(f is frame for f in frames)
    array[0] = 1.0
    assert given[1][0] == 0.0


def test_the_caller_works_too_and_the_others_are_measured():
    with Processes(2) as two:
        pids = set(two.map(where, range(60)))
        used = two.usage()
    assert os.getpid() in pids and len(pids) == 2
    assert used.cpu_s > 0.05 and used.peak_rss_mb > 10


def test_no_process_is_started_for_one_item():
    with Processes(2) as two:
        assert list(two.map(where, [0])) == [os.getpid()]


def test_few_pixels_are_worked_on_in_this_process():
    with Processes(2) as two:
        two.fit(40 * 640 * 480)
        assert set(two.map(where, range(8))) == {os.getpid()}
    with Processes(2) as two:
        two.fit(1000 * 640 * 480)
        assert two.count == 2


def test_items_are_taken_as_they_are_needed():
    taken = []

    def items():
        for n in range(100):
            taken.append(n)
            yield n

    with Processes(2) as two:
        results = two.map(square, items())
        assert next(results) == 0
        assert len(taken) < 20
        results.close()


def test_an_error_comes_at_its_items_turn():
    with Processes(2) as two:
        results = two.map(refuse, range(8))
        assert [next(results) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(ValueError, match="three"):
            next(results)


def test_a_killed_worker_is_one_clear_error():
    me = os.getpid()
    with Processes(2) as two:
        pid = next(p for p in two.map(where, range(40)) if p != me)
        assert pid != me
        pool = two._started()
        future = pool.submit(die, 1)
        with pytest.raises(OrthoSwarmError, match="fewer --workers"):
            two._account(future)


def test_each_process_keeps_to_one_thread():
    with Processes(2) as two:
        assert {cv for _, cv in two.map(threads, range(4))} == {1}


def test_helpers(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    prepare_process()
    assert os.environ["OMP_NUM_THREADS"] == "1"
    assert isinstance(workers(1), Serial)
    assert workers(4).count == 4
    assert workers().count == cores() >= 1
    assert peak_rss_mb() > 10


PARENT = """
import os, sys
from orthoswarm.compute.workers import Processes
from tests.batch.test_workers import where
pool, others = Processes(3), set()
while not others:
    others = set(pool.map(where, range(40))) - {os.getpid()}
print(*others, flush=True)
sys.stdin.read()
"""


def test_workers_end_with_a_parent_that_was_killed():
    root = Path(__file__).parents[2]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", PARENT], cwd=root, text=True, **pipes) as parent:
        assert parent.stdout is not None and parent.stdout.readline().split()
        parent.kill()
        # Workers hold the other end of this pipe: it ends with the last of them, and never if they wait on.
        assert parent.communicate(timeout=240) == ("", None)


def test_a_worker_does_not_inherit_the_path_that_opencv_is_imported_with():
    """While OpenCV is being imported its folder, which holds a `typing`, is on the path that a spawned process gets."""
    code = (
        "import sys, threading\n"
        "from orthoswarm.compute.workers import spawn_context\n"
        "thread = threading.Thread(target=__import__, args=('cv2',))\n"
        "thread.start()\n"
        "context = spawn_context()\n"
        "paths = [p for p in sys.path if p.rstrip('/').endswith('cv2')]\n"
        "assert 'cv2' in sys.modules and not paths, paths\n"
    )
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


FORKING = """
import os, sys, threading, time
from orthoswarm.batch.workspace import Workspace
from orthoswarm.compute.workers import Processes, cheapest_context
from pathlib import Path
from tests.batch.test_workers import forked

print(cheapest_context().get_start_method())
wait = threading.Event()
thread = threading.Thread(target=wait.wait)
thread.start()
print(cheapest_context().get_start_method())
wait.set()
thread.join()
while len(os.listdir("/proc/self/task")) > 1:  # a thread that was joined may still be ending
    time.sleep(0.001)
with Workspace(Path(sys.argv[1])) as space:
    with Processes(2) as two:
        others = {}
        while not others:
            others = {pid: parent for pid, parent in two.map(forked, range(40)) if pid != os.getpid()}
        space.close()
        with Workspace(Path(sys.argv[1])):  # the worker lives on, and holds no lock
            print(*set(others.values()))"""


def forked(_):
    """This process, and whether it has what its parent made after it had started."""
    import __main__

    where(0)
    return os.getpid(), hasattr(__main__, "FORKED_FROM")


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="this system does not tell the number of threads")
def test_workers_are_forked_from_a_process_of_one_thread_only(tmp_path):
    root = Path(__file__).parents[2]
    code = FORKING.replace("with Workspace", "FORKED_FROM = os.getpid()\nwith Workspace", 1)
    done = subprocess.run([sys.executable, "-c", code, tmp_path], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["fork", "spawn", "True"]


def test_threads_take_arguments_as_they_are_needed_and_give_results_in_order():
    taken = []
    results = on_threads(lambda k: k * k, (taken.append(k) or k for k in range(1000)), count=3)
    assert [next(results) for _ in range(5)] == [0, 1, 4, 9, 16]
    assert 5 <= len(taken) <= 12
    assert list(results) == [k * k for k in range(5, 1000)]


def test_an_error_on_a_thread_ends_the_work():
    taken = []
    results = on_threads(lambda k: 1 // (5 - k), (taken.append(k) or k for k in range(1000)), count=2)
    with pytest.raises(ZeroDivisionError):
        list(results)
    assert len(taken) < 20
