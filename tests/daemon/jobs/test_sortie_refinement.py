"""A refinement waits for the map that its first picture begins."""

import threading
from dataclasses import dataclass, field

import pytest

from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.sortie_refinement import SortieRefinement
from gcs_plugin.daemon.store.job_rows import Job

JOB = Job(
    id=1,
    kind="refine",
    vehicle="v1",
    sortie=1,
    state="running",
    progress=0.0,
    message="",
    created=0.0,
    started=0.0,
    ended=None,
    attempts=1,
)


@dataclass
class Drawing:
    """A real-time layer that is asked in vain a number of times before its first picture is drawn."""

    busy: int
    begins: bool = True
    asked: int = 0
    area: object = None
    stops: bool = False
    stopping: threading.Event = field(default_factory=threading.Event)

    def wait_drawn(self, vehicle, sortie, timeout_s):
        self.asked += 1
        if self.asked == 4 and self.stops:
            self.stopping.set()
        if self.asked <= self.busy:
            return False
        self.area = object() if self.begins else None
        return True


def wait(drawing):
    run = RunningJob(JOB, None, drawing.stopping, None)
    SortieRefinement(publisher=None, store=None, kept=None, drawer=drawing).wait_drawn(run)


@pytest.mark.parametrize("busy", [0, 5])
def test_it_waits_until_the_first_picture_has_begun_the_map(busy):
    drawing = Drawing(busy)
    wait(drawing)
    assert drawing.area is not None and drawing.asked == busy + 1


def test_it_waits_no_longer_where_no_picture_can_begin_it():
    drawing = Drawing(2, begins=False)
    wait(drawing)
    assert drawing.asked == 3


def test_it_waits_no_longer_once_the_daemon_ends():
    drawing = Drawing(1000, stops=True)
    wait(drawing)
    assert drawing.asked == 4
