"""Logs of a CAN bus with DroneCAN on it: candump's .log, Vector's .asc and .blf, PEAK's .trc, by python-can's readers.

Several nodes may send the same value; at each moment the one with the lowest stated sigma is used. Fixes carry UTC,
which dates the rest of the log; without them the log's own times are used if they are dates.
"""

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from telemetry.formats.log.dronecan_poses import DronecanPoses, NodePose
from telemetry.formats.log.log_data import LEAST_STEP_S, FlightLog, NotALog
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample
from telemetry.samples.times import YEAR_2000_S
from telemetry.samples.unreadable import beginning

SUFFIXES: Final = frozenset({".log", ".asc", ".blf", ".trc"})

_MOST_DAMAGE: Final = 1000
_SILENT_S: Final = 2.0
_UNSTATED: Final = float("inf")
_HEADS: Final = {
    ".log": re.compile(rb"\s*\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{3,8}#"),
    ".asc": re.compile(rb"(\s*//[^\n]*\n)*\s*(date|base)\s", re.IGNORECASE),
    ".blf": re.compile(rb"LOGG"),
    ".trc": re.compile(rb"\s*;"),
}

_NO_SIZE: Final = re.compile(rb"LOBJ(?=.{4}\0{4})", re.DOTALL)
"""An object of a .blf: signature, sizes of its header and version (2 bytes each), its size (4 bytes)."""


def is_can_log(path: Path) -> bool:
    """Whether a file begins like a CAN log; other kinds of files share these suffixes."""
    head = _HEADS.get(path.suffix.lower())
    return head is not None and head.match(beginning(path, 4096)) is not None


@dataclass(slots=True)
class _Reading:
    """What was read from a log so far: poses, undated poses, number of frames, and damaged places."""

    poses: list[tuple[str, NodePose]] = field(default_factory=list)
    undated: list[tuple[DronecanPoses, NodePose]] = field(default_factory=list)
    frames: int = 0
    damaged: int = 0


def read_can_log(path: Path) -> FlightLog:
    """Read the positions and attitudes that nodes sent on a bus.

    Raises:
        OSError: it cannot be read. NotALog: it holds no CAN frame, or none of the DroneCAN messages that are read here.
    """
    if not is_can_log(path):
        raise NotALog(f"the file is not the log of a CAN bus ({', '.join(sorted(SUFFIXES))}); it is left out")
    reading, buses = _Reading(), dict[str, DronecanPoses]()
    for message in _messages(path, reading):
        reading.frames += 1
        if not message.is_extended_id or message.is_error_frame or message.is_remote_frame:
            continue
        channel = str(message.channel)
        bus = buses.setdefault(channel, DronecanPoses())
        pose = bus.feed(message.arbitration_id, bytes(message.data), message.timestamp, fd=message.is_fd)
        if pose is None:
            continue
        reading.poses.append((f"{channel}, node {pose.node}", pose))
        if not bus.knows_utc:
            reading.undated.append((bus, pose))
    if not reading.frames:
        raise NotALog("the log holds no CAN frame that can be read; record it again")
    if not reading.poses:
        raise NotALog("the CAN log holds no DroneCAN position or attitude (gnss.Fix2, ahrs.Solution, gimbal Status)")
    for bus, pose in reading.undated:
        pose.sample.time_s = bus.utc(pose.sample.time_s or 0.0)
    poses = [(key, pose) for key, pose in reading.poses if (pose.sample.time_s or 0.0) > YEAR_2000_S]
    log = FlightLog(path=path, kind="DroneCAN", vehicle=path.stem)
    for kind in ("lat_deg", "flight_yaw_deg", "yaw_deg"):
        log.samples += _best([(key, pose) for key, pose in poses if getattr(pose.sample, kind) is not None])
    log.has_gimbal = any(sample.yaw_deg is not None for sample in log.samples)
    log.findings = _findings(path, reading, buses, len(reading.poses) - len(poses))
    return log


def _messages(path: Path, reading: _Reading) -> Iterator[Any]:
    """The frames of a log; damaged places are skipped."""
    import can

    log = None
    try:
        log = _blf_reader(path) if path.suffix.lower() == ".blf" else can.LogReader(str(path))
        while reading.damaged < _MOST_DAMAGE:
            try:
                yield from log
                return
            except OSError:
                raise
            # python-can's readers may fail anywhere in a damaged file; the next line or record may be complete
            except Exception:
                reading.damaged += 1
    except OSError:
        raise
    except Exception as error:
        raise NotALog(f"the CAN log cannot be read ({type(error).__name__}: {error}); record it again") from None
    finally:
        if log is not None:
            log.stop()


def _blf_reader(path: Path) -> Any:
    """python-can's reader of Vector's .blf, safe against damaged files.

    It follows the size that each object states. In a damaged file that may be 0, and the reader then stays at this
    object for ever. An object of no size is given another signature, which the reader takes for damage.
    """
    import can

    class BlfReader(can.BLFReader):  # type: ignore[misc]
        def _parse_data(self, data: bytes) -> Iterator[can.Message]:
            yield from super()._parse_data(_NO_SIZE.sub(b"damg", data))

    # A line for each object of an unknown kind would fill the terminal; our own finding counts damaged places.
    logging.getLogger("can.io.blf").setLevel(logging.ERROR)
    return BlfReader(str(path))


def _best(poses: list[tuple[str, NodePose]]) -> list[Sample]:
    """Poses of one kind, without those of nodes for which a node with a lower sigma reports at that time."""
    nodes: dict[str, list[NodePose]] = {}
    for key, pose in poses:
        nodes.setdefault(key, []).append(pose)

    def sigma(key: str) -> float:
        return float(np.median([_UNSTATED if pose.sigma is None else pose.sigma for pose in nodes[key]]))

    best: list[Sample] = []
    times = np.zeros(0)
    for key in sorted(nodes, key=sigma):
        fresh: list[Sample] = []
        for pose in nodes[key]:
            time_s = pose.sample.time_s or 0.0
            at = int(np.searchsorted(times, time_s))
            reported = any(abs(times[i] - time_s) < _SILENT_S for i in (at - 1, at) if 0 <= i < len(times))
            if not reported and (not fresh or not 0.0 <= time_s - (fresh[-1].time_s or 0.0) < LEAST_STEP_S):
                fresh.append(pose.sample)
        best += fresh
        times = np.sort([sample.time_s or 0.0 for sample in best])
    return best


def _findings(path: Path, reading: _Reading, buses: dict[str, DronecanPoses], undated: int) -> list[Finding]:
    found = []
    if reading.damaged:
        text = f"{plural(reading.damaged, 'place')} of {path.name} are damaged and were skipped"
        found.append(Finding("can-damaged", text))
    if undated:
        text = f"{plural(undated, 'message')} of {path.name} have no date: no receiver on the bus stated UTC"
        found.append(Finding("can-undated", text))
    for bus in buses.values():
        for node, lost in sorted(bus.lost.items()):
            if lost > 0.02 * bus.received[node]:
                text = (
                    f"{plural(lost, 'message')} of node {node} are missing in {path.name} ({bus.received[node]} came)"
                )
                found.append(Finding("can-lost", text, note=True))
    return found
