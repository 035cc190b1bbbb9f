"""The simulator process of the demonstration: vehicles on TCP links, cameras on TCP streams."""

import signal
import threading
import time
from multiprocessing.connection import Connection
from typing import Any, Final

from gcs_plugin.demo.setting import DemoSetting

_MOST_WAITING: Final = 4  # pictures
_SLOW: Final = 0.15  # times real time while cameras lag behind
_BEHIND_S: Final = 0.05


class PacedClock:
    """A clock that slows down while rendering is behind: a slow machine flies slower and loses no picture."""

    def __init__(self) -> None:
        self._real, self._now, self.slow = time.monotonic(), 0.0, False
        self._lock = threading.Lock()

    def __call__(self) -> float:
        """Simulated seconds since the start."""
        with self._lock:
            real = time.monotonic()
            self._now += (real - self._real) * (_SLOW if self.slow else 1.0)
            self._real = real
            return self._now


def simulate(setting: DemoSetting, pipe: Connection) -> None:
    """Run until "stop" is received or the pipe is closed.

    Sends {"links": [...], "streams": [...]} first, and {"taken": N, "problem": text} at the end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # not all systems inherit this from the parent process
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    from gcs_plugin.demo.simulated_camera import RenderQueue, TwinCamera, VideoServer
    from gcs_plugin.sim.multirotor import Airframe
    from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
    from orthoswarm.twin.dataset_files import damaged_city

    stage, site = damaged_city(setting.twin)
    systems = range(1, setting.vehicles + 1)
    renderer = RenderQueue(
        cameras={s: TwinCamera(stage, site, setting, s) for s in systems},
        servers={s: VideoServer() for s in systems},
    )
    airframe = Airframe(climb_m_s=8.0, sink_m_s=6.0, gps_sigma_m=0.8)
    vehicles = make_swarm(
        setting.vehicles, home=setting.home(), airframe=airframe, seed=setting.seed, on_exposure=renderer.expose
    )
    clock = PacedClock()
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=setting.speed, clock=clock) as swarm:
        streams = [renderer.servers[s].url for s in systems]
        pipe.send({"links": swarm.addresses, "streams": streams})
        while not _stop_received(pipe):
            clock.slow = renderer.backlog > _MOST_WAITING
    renderer.close()
    _send(pipe, {"taken": renderer.taken, "problem": renderer.problem})


def _stop_received(pipe: Connection) -> bool:
    try:
        return pipe.poll(_BEHIND_S) and pipe.recv() == "stop"
    except (EOFError, OSError):
        return True


def _send(pipe: Connection, message: dict[str, Any]) -> None:
    try:
        pipe.send(message)
    except OSError:  # the demonstration has ended already
        return
