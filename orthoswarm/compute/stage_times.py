"""How long each stage took, over all processes."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from orthoswarm.compute.workers import Usage, peak_rss_mb


@dataclass(slots=True)
class Stage:
    """One stage of a run.

    Attributes:
        name: begins with load, realtime, coarse, fine or final.
        wall_s: wall seconds. cpu_s: CPU seconds of this process and the workers. items: number of items processed.
    """

    name: str
    wall_s: float = 0.0
    cpu_s: float = 0.0
    items: int = 0


@dataclass(slots=True)
class Clock:
    """Measures stages.

    Attributes:
        usage: what other processes have used so far.
        stages: those done, in order.
    """

    usage: Callable[[], Usage]
    stages: list[Stage] = field(default_factory=list)
    _wall: float = field(default_factory=time.perf_counter)
    _cpu: float = field(default_factory=time.process_time)

    @contextmanager
    def stage(self, name: str, items: int = 0) -> Iterator[Stage]:
        """Context manager that measures its body; the stage is recorded when it ends."""
        stage = Stage(name, items=items)
        wall, cpu = time.perf_counter(), self._cpu_now()
        yield stage
        stage.wall_s += time.perf_counter() - wall
        stage.cpu_s += self._cpu_now() - cpu
        self.stages.append(stage)

    def totals(self) -> tuple[float, float, float]:
        """Wall seconds, CPU seconds and peak memory (MB, sum over processes) since the clock was made."""
        return (
            time.perf_counter() - self._wall,
            self._cpu_now() - self._cpu,
            peak_rss_mb() + self.usage().peak_rss_mb,
        )

    def _cpu_now(self) -> float:
        return time.process_time() + self.usage().cpu_s
