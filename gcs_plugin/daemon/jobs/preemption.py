"""Jobs in the background, which give way to the refinements of completed sorties."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from gcs_plugin.daemon.jobs.job_queue import Preempted
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from orthoswarm.model.errors import OrthoSwarmError


@dataclass(slots=True)
class Preemption:
    """Stops a running job from another thread, so that it is queued again.

    Attributes:
        workers: compute the job; used by nothing else meanwhile.
        vehicle: whose job is running, empty for one of all vehicles, None while there is none.
        requested: the running job is to give way.
    """

    workers: WorkerPool
    vehicle: str | None = None
    requested: bool = False

    @contextmanager
    def running(self, vehicle: str = "") -> Iterator[None]:
        """The time in which a job can be stopped; `vehicle`: whose job it is, empty for one of all vehicles.

        Raises:
            Preempted: instead of an OrthoSwarmError of the job, if it was stopped.
        """
        self.vehicle, self.requested = vehicle, False
        try:
            yield
        except OrthoSwarmError:
            if self.requested:
                raise Preempted from None
            raise
        finally:
            self.vehicle = None

    def stop(self) -> None:
        """Stop the running job, if there is one."""
        if self.vehicle is not None:
            self.requested = True
            self.workers.abandon()
