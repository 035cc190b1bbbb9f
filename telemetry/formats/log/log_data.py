"""The content of a flight log in a common form, and helpers shared by its readers."""

import contextlib
import mmap
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from telemetry.formats.log.mavlink_poses import ExposureEvent
from telemetry.samples.findings import Finding
from telemetry.samples.sample import Sample, checked
from telemetry.samples.timeline import Timeline
from telemetry.samples.unreadable import Unreadable

Row = dict[str, Any]  # one record of a binary log


LEAST_STEP_S = 0.04
"""Attitude and position are kept at 25 Hz at most: more adds nothing, and a long log would fill the memory."""


class NotALog(Unreadable):
    """A file with a log's suffix is not a log; the text is one sentence for the user."""


@dataclass(slots=True, kw_only=True)
class FlightLog:
    """One vehicle's log."""

    path: Path  # the file
    kind: str  # "tlog", "DataFlash", "ULog", "DroneCAN" and so on
    vehicle: str  # "sysid3" or the file's name
    samples: list[Sample] = field(default_factory=list)  # poses over UTC, in order
    events: list[ExposureEvent] = field(default_factory=list)  # exposures, in order
    has_gimbal: bool = False  # whether the camera's own attitude was logged
    findings: list[Finding] = field(default_factory=list)  # irregularities, for the user
    # last horizontal sigma stated by the autopilot's receiver, None if it stated none
    position_sigma_m: float | None = None
    max_gap_s: float = 2.0  # positions farther apart in time are not interpolated between

    def timeline(self) -> Timeline:
        """Its poses, which can be read at any time."""
        return Timeline(self.samples, max_gap_s=self.max_gap_s)


@contextlib.contextmanager
def mapped(path: Path) -> Iterator[mmap.mmap]:
    """A log's bytes without reading them all into memory. Raises OSError: it cannot be read."""
    with path.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield data


def is_later(by_s: float) -> bool:
    """Whether a record is late enough after the last one that was kept to be kept, too."""
    return not 0.0 <= by_s < LEAST_STEP_S


def add_sample(log: FlightLog, time_s: float | None, **values: Any) -> None:
    """Add a pose to a log if it is dated and has valid values: where it states a position, a valid one."""
    sample = checked(Sample(**values))
    if sample is not None and time_s is not None and (sample.has_position or "lat_deg" not in values):
        sample.time_s = time_s
        log.samples.append(sample)


def each(rows: Iterable[Row], take: Callable[[Row], None]) -> None:
    """Process every record; records with missing fields or fields of the wrong type (a damaged format) are skipped."""
    for row in rows:
        with contextlib.suppress(KeyError, TypeError, ValueError, ArithmeticError):
            take(row)
