"""Resource usage of the daemon's processes."""

import os
from pathlib import Path

from orthoswarm.compute.workers import Usage, peak_rss_mb


def resident_mb() -> float:
    """Memory of this process now, megabytes."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, AttributeError):  # not Linux: the largest so far
        return peak_rss_mb()


def used_by(pid: int) -> Usage:
    """Usage of another process so far; zero if it has ended, or if the system does not report it (not Linux)."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
        ran = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        largest = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")), 0)
        return Usage((int(ran[11]) + int(ran[12])) / os.sysconf("SC_CLK_TCK"), largest * 1024 / 1e6)
    except (OSError, ValueError, IndexError, AttributeError):
        return Usage()
