"""The survey of a set of inputs, source by source, and the options for reading them."""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from orthoswarm.model.frame import Frame, Rejection
from telemetry.ingest.discovery import Discovery, natural_key
from telemetry.samples.findings import Finding
from telemetry.samples.sample import Sample


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOptions:
    """Options for reading inputs.

    Attributes:
        every_m: distance between pictures extracted from a video, metres; None for the default of `picture_choice`.
        every_s: time between them, seconds.
        cache: folder for pictures extracted from videos; None makes one under the system's temporary folder.
        exclude: files and folders that are left out (the output folder, for instance). workers: threads that read.
        camera: which sensor of cameras with several is mapped: wide, zoom or thermal; "" for the widest in colour.
        band: which spectral band of multispectral cameras is mapped; "" for colour, else the one that shows most.
        decode: False to read only the metadata of videos, without extracting pictures (for `inspect`).
        run: maps a function over items in processes, for many photos; None: read in threads.
        sei_layouts: files that describe private SEI messages; see `telemetry.formats.video.sei`.
    """

    every_m: float | None = None
    every_s: float | None = None
    cache: Path | None = None
    exclude: tuple[Path, ...] = ()
    workers: int = field(default_factory=lambda: min(8, (os.cpu_count() or 1) * 2))
    camera: str = ""
    band: str = ""
    decode: bool = True
    run: Callable[..., Iterator[Any]] | None = None
    sei_layouts: tuple[Path, ...] = ()


@dataclass(slots=True, kw_only=True)
class SourceInfo:
    """One source for `inspect`: a folder of photos, a video, a log or a table.

    Attributes:
        path: relative to the inputs' root. kind: "photos", "video", "geo.txt" and so on.
        counts: `frames`, `sei`, `klv`, `camera_events`. findings: what is suspicious about it. frames: the frames.
        tracks: for sources without frames, the poses of each vehicle in order.
        shown: number of pictures of each vehicle if it differs from the number of its frames.
        sees: sensor and band of its pictures, as `Photo` has them.
    """

    path: str
    kind: str
    counts: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    tracks: dict[str, list[Sample]] = field(default_factory=dict)
    shown: dict[str, int] = field(default_factory=dict)
    sees: tuple[str, str] = ("", "")


@dataclass(slots=True, kw_only=True)
class Survey:
    """All sources of a set of inputs."""

    root: Path
    discovery: Discovery | None = None
    sources: list[SourceInfo] = field(default_factory=list)
    rejected: list[Rejection] = field(default_factory=list)
    unpositioned: list[Frame] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def frames(self) -> list[Frame]:
        """All frames by vehicle, then time, then natural name order."""
        return sorted((frame for source in self.sources for frame in source.frames), key=_frame_key)


def _frame_key(frame: Frame) -> tuple[object, ...]:
    return (
        natural_key(frame.vehicle),
        frame.vehicle,
        math.inf if frame.time_s is None else frame.time_s,
        natural_key(frame.image),
    )
