"""The daemon's figures as Prometheus text."""

import os
import time
from typing import Final

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.store.frame_rows import stage_counts
from gcs_plugin.daemon.store.job_rows import job_counts
from orthoswarm import __version__
from orthoswarm.compute.workers import peak_rss_mb

_QUANTILES: Final = (0.5, 0.9, 0.99, 1)


def prometheus(daemon: Daemon, uploads_waiting: int = 0) -> str:
    """All figures, one metric a line with its help and type."""
    lines: list[str] = []

    def metric(name: str, kind: str, text: str, values: list[tuple[dict[str, str], float]]) -> None:
        lines.append(f"# HELP orthoswarm_{name} {text}")
        lines.append(f"# TYPE orthoswarm_{name} {kind}")
        for labels, value in values:
            inner = ",".join(f'{key}="{_escape(label)}"' for key, label in labels.items())
            lines.append(f"orthoswarm_{name}{'{' + inner + '}' if inner else ''} {_number(value)}")

    def single(name: str, kind: str, text: str, value: float) -> None:
        metric(name, kind, text, [({}, value)])

    drawer = daemon.drawer
    metric("info", "gauge", "The program's version.", [({"version": __version__}, 1)])
    single("uptime_seconds", "gauge", "Since the daemon was started.", time.time() - daemon.started)
    stages = stage_counts(daemon.journal).items()
    metric("frames", "gauge", "Frames in the workspace by stage.", [({"stage": stage}, n) for stage, n in stages])
    single(
        "frames_accepted_total", "counter", "Pictures accepted since the start.", sum(daemon.intake.accepted.values())
    )
    single("frames_drawn_total", "counter", "Frames drawn in real time since the start.", drawer.drawn)
    single("frames_late_total", "counter", "Frames drawn later than a second after they came.", drawer.late)
    single("draw_backlog", "gauge", "Frames that wait to be drawn.", drawer.backlog)
    single("draw_put_off", "gauge", "Frames that wait because they would show least.", drawer.put_off)
    text = "Longest time for which newer pictures of a vehicle have come than any that is drawn."
    single("draw_behind_seconds", "gauge", text, drawer.behind_s)
    recent = sorted(drawer.latencies)
    metric(
        "draw_latency_seconds", "gauge", "From arrival to the map, of the last thousand frames.",
        [({"quantile": str(q)}, recent[min(len(recent) - 1, int(q * len(recent)))]) for q in _QUANTILES if recent],
    )  # fmt: skip
    metric(
        "layer_version", "gauge", "Grows with every change of a layer.",
        [({"layer": name}, layer.version) for name, layer in daemon.layers.items()],
    )  # fmt: skip
    counts = job_counts(daemon.journal)
    metric("jobs", "gauge", "Jobs by kind and state.", [({"kind": k, "state": s}, n) for (k, s), n in counts.items()])
    single("journal_commits_total", "counter", "Commits since the start.", daemon.journal.commits)
    metric(
        "pictures_refused_total", "counter", "Pictures refused, or not on the map, since the start, by cause.",
        [({"cause": cause}, count) for cause, count in daemon.refused.counts.items()],
    )  # fmt: skip
    single("uploads_waiting", "gauge", "Posted pictures that wait for their turn.", uploads_waiting)
    covered = daemon.coverage.document
    names = ("seen", "poor", "missed", "planned")
    shares = {name: covered[f"{name}_share"] for name in names}  # type: ignore[literal-required]
    metric(
        "coverage_share", "gauge", "Share of the planned area by state.",
        [({"state": name}, share) for name, share in shares.items() if share is not None],
    )  # fmt: skip
    single("coverage_gaps", "gauge", "Gaps in the planned area.", len(covered["gaps"]))
    single("coverage_seconds", "gauge", "Time that finding the gaps took last.", daemon.coverage.seconds)
    single("problems", "gauge", "Problems at present.", len(daemon.problems()))
    single("cpu_seconds_total", "counter", "CPU time of the daemon's own process.", time.process_time())
    single("resident_megabytes", "gauge", "Memory of the daemon's own process.", _resident_mb())
    return "\n".join(lines) + "\n"


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").encode("utf-8", "replace").decode()


def _number(value: float) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _resident_mb() -> float:
    """Memory of this process now, megabytes."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, AttributeError):  # not Linux: the largest so far
        return peak_rss_mb()
