"""What the daemon's own process uses."""

import os

from orthoswarm.workers import peak_rss_mb


def resident_mb() -> float:
    """Memory of this process now, megabytes."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, AttributeError):  # not Linux: the largest so far
        return peak_rss_mb()
