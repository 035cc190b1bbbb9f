"""More pictures than can be drawn: those that would show least are put off, it is said, and nothing is lost."""

import contextlib
import threading
import time
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.daemon.intake.posted_pose import frame_of, parse_pose
from gcs_plugin.daemon.layers.draw_queue import DrawQueue, MapDelay, PendingFrame
from gcs_plugin.daemon.layers.layers import MapLayer
from gcs_plugin.daemon.layers.map_site import ExpectedPlace, MapSite
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.layers.web_tiles import TileServer
from gcs_plugin.daemon.store.daemon_events import Events, PictureStored
from gcs_plugin.daemon.store.frame_rows import add_frame, undrawn_frames
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.picture_store import PictureStore, frame_key
from gcs_plugin.daemon.web_plans import Plans
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.raster.picture_file import read_rgba
from tests.kit.daemon_kit import GRID, SIZE, camera_at, jpeg, pose_of
from tests.kit.mosaic_scene import EAST, NORTH


def pending(seq, east, north=0.0, height=100.0):
    lat, lon = (float(v) for v in GRID.to_geographic([EAST + east, NORTH + north]))
    return PendingFrame(
        seq,
        0.0,
        1,
        Frame(
            image=f"{seq}.jpg",
            path=None,
            vehicle="v1",
            time_s=float(seq),
            fix=Fix(lat, lon, height),
            width=SIZE[0],
            height=SIZE[1],
        ),
    )


def drained(queue):
    out = []
    while (one := queue.take()) is not None:
        out.append(one.seq)
    return out


def test_while_it_keeps_up_frames_are_drawn_as_they_come():
    queue = DrawQueue(100, in_order=0)
    for seq in range(20):
        queue.put(pending(seq, 4.0 * seq))
        assert queue.take().seq == seq
    assert len(queue) == 0


def test_pictures_are_drawn_as_they_came_while_few_wait():
    queue = DrawQueue(100, in_order=3)
    for seq, east in ((1, 3.0), (2, 6.0), (3, 400.0), (4, 6.1)):
        queue.put(pending(seq, east))
    assert queue.take().seq == 1  # four wait: all of them show new ground
    assert [queue.take().seq for _ in range(3)] == [2, 3, 4]
    assert queue.take() is None


def test_ground_that_is_empty_goes_first():
    queue = DrawQueue(100, in_order=0)
    queue.put(pending(0, 0.0))
    assert queue.take().seq == 0
    for seq, east in ((1, 3.0), (2, 6.0), (3, 400.0), (4, 20.0), (5, 403.0)):
        queue.put(pending(seq, east))
    order = drained(queue)
    assert order[0] == 3
    assert order[1] == 4
    assert set(order[2:]) == {1, 2, 5}


def test_the_first_few_of_a_jam_are_spread_over_its_ground():
    """Of 400 frames along 800 m, the first 40 that are drawn leave no gap as wide as the 40 that came first would."""
    queue = DrawQueue(1000, in_order=0)
    for seq in range(400):
        queue.put(pending(seq, 2.0 * seq))
    first = sorted(2.0 * queue.take().seq for _ in range(40))
    assert max(np.diff([0.0, *first, 800.0])) < 60.0


def test_in_a_jam_the_map_follows_every_vehicle():
    """96 vehicles send 192 pictures a second, 96 can be drawn: no vehicle's newest waits for two seconds."""
    queue, delay, behind = DrawQueue(2000, in_order=0), MapDelay(), []
    for turn in range(20):  # each half a second
        for vehicle in range(96):
            seq, arrived = 96 * turn + vehicle, 0.5 * turn + vehicle / 192
            came = pending(seq, 100.0 * vehicle, 8.0 * turn)
            queue.put(replace(came, arrived=arrived, frame=replace(came.frame, vehicle=f"v{vehicle}")))
            delay.came(f"v{vehicle}", arrived)
            if vehicle % 2:
                drawn = queue.take()
                delay.drawn(drawn.frame.vehicle, drawn.arrived)
                behind.append(delay.seconds(arrived))
    assert len(queue) == 960
    assert 0.0 < max(behind) < 2.0


def test_what_a_later_picture_shows_does_not_count_as_waiting():
    delay = MapDelay()
    assert delay.seconds(5.0) == 0.0
    for arrived in (1.0, 2.0, 3.0):
        delay.came("v1", arrived)
    delay.came("v2", 2.5)
    assert delay.seconds(5.0) == 4.0
    delay.drawn("v1", 2.0)
    assert delay.seconds(5.0) == 2.5
    delay.drawn("v1", 1.0)
    delay.drawn("v2", 2.5)
    assert delay.seconds(5.0) == 2.0
    delay.drawn("v1", 3.0)
    delay.drawn("v3", 3.0)
    assert delay.seconds(5.0) == 0.0


@settings(deadline=None, max_examples=40)
@given(st.lists(st.integers(0, 300), min_size=1, max_size=60), st.integers(1, 30))
def test_nothing_disappears_from_the_queue(places, most):
    queue, left = DrawQueue(most, in_order=0), set()
    for seq, place in enumerate(places):
        out = queue.put(pending(seq, float(place)))
        if out is not None:
            left.add(out.seq)
        assert len(queue) <= most
    drawn = drained(queue)
    assert len(drawn) == len(set(drawn)) == min(most, len(places))
    assert set(drawn) | left == set(range(len(places)))
    assert not set(drawn) & left


def test_a_full_queue_lets_go_of_what_shows_least():
    queue = DrawQueue(3, in_order=0)
    queue.put(pending(0, 0.0))
    assert queue.take().seq == 0
    for seq, east in ((1, 2.0), (2, 300.0), (3, 600.0)):
        assert queue.put(pending(seq, east)) is None
    assert queue.put(pending(4, 900.0)).seq == 1  # new ground takes the place of what is drawn nearly the same
    assert queue.put(pending(5, 1.0)).seq == 5


def wait_until(done):
    end = time.monotonic() + 240
    while not done():
        assert time.monotonic() < end
        time.sleep(0.05)


class RecordedEvents(Events):
    """Events that are recorded instead of handed to listeners."""

    def __init__(self):
        super().__init__()
        self.told = []

    def publish(self, event):
        self.told.append(event)


@contextlib.contextmanager
def drawing(folder, read, **options):
    """A drawer with its journal, a function that sends it a picture, and what it has told."""
    events, layer = RecordedEvents(), MapLayer("realtime")
    journal, store = Journal(folder / "journal.db"), PictureStore(folder / "p")
    (folder / "layers").mkdir()
    expected = ExpectedPlace(TileServer({}), Plans(folder / "plans", None, None).newest_bounds)
    site = MapSite(
        journal, layer, folder / "layers", gsd_m=0.5, fov_rad=None, expected=expected, events=events, memory_mb=64.0
    )
    drawer = Drawer(journal, store, site, events, in_memory=12, read=read, **options)
    drawer.start()
    data = jpeg(camera_at())

    def send(k, camera):
        pose = parse_pose(pose_of(camera, f"{k:03d}.jpg"))
        key = frame_key("v1", pose.image)
        path = store.put(key, ".jpg", data)
        seq, _ = journal.write(
            add_frame(key, "v1", pose.image, time_s=float(k), path=path, size=SIZE, pose=pose.values)
        )
        frame = frame_of(pose.values, image=pose.image, path=store.path(path), vehicle="v1", time_s=float(k), size=SIZE)
        drawer.picture_stored(
            PictureStored(seq=seq, frame=frame, arrived_s=time.time(), sortie=1, has_fix=True, count=1)
        )

    try:
        yield drawer, journal, send, events.told
    finally:
        drawer.close()
        layer.close()
        journal.close()


def test_a_jam_is_told_and_everything_is_drawn_in_the_end(tmp_path):
    in_time, may_read = threading.Event(), threading.Semaphore(0)

    def slowly(path):
        if not in_time.is_set():
            assert may_read.acquire(timeout=240)
        return read_rgba(path)

    with drawing(tmp_path, slowly, late_s=0.2, look_s=0.05) as (drawer, journal, send, told):
        for k in range(90):  # fifteen near one another at each of six places, one place after the other
            send(k, camera_at(60.0 * (k // 15), 0.4 * (k % 15)))
            assert drawer.backlog <= 12
            if k % 15 == 14:  # two of each place are drawn before those of the next come, however fast the machine is
                may_read.release(2)
                wait_until(lambda place=k // 15: drawer.drawn >= 2 * (place + 1))
        may_read.release()
        wait_until(lambda: drawer.overload or may_read.release())
        assert "safe on the disk" in drawer.overload
        in_time.set()
        may_read.release(100)
        wait_until(lambda: not undrawn_frames(journal, 1))
        rows = journal.rows("SELECT seq, drawn, reason FROM frames")
    order = [event.told["seq"] for event in told if event.page == "frame"]
    assert [(row["drawn"], row["reason"]) for row in rows] == [(1, None)] * 90
    assert sorted(order) == sorted(row["seq"] for row in rows)  # each once
    last_place = {seq for seq in order if (seq - min(order)) // 15 == 5}
    assert min(order.index(seq) for seq in last_place) < 60  # not after all that came before
    assert any(event.page == "overload" and event.told["put_off"] > 0 for event in told)


def test_the_end_of_a_jam_is_told_though_nothing_comes_after_it(tmp_path):
    all_came = threading.Event()

    def late(path):
        assert all_came.wait(240)
        return read_rgba(path)

    with drawing(tmp_path, late, late_s=0.0, look_s=60.0) as (drawer, journal, send, told):
        for k in range(40):
            send(k, camera_at(5.0 * k))
        all_came.set()
        wait_until(lambda: not undrawn_frames(journal, 1))
        wait_until(lambda: not drawer.overload)
    put_off = [event.told["put_off"] for event in told if event.page == "overload"]
    assert put_off[0] > 0 == put_off[-1]
