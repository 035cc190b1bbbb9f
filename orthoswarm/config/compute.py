"""Workers and memory. These change how long a run takes, never its products."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeConfig:
    """Workers and memory. These change how long a run takes, never its products."""

    cluster_connect_s: float = 20.0
    """Time to reach a Dask scheduler, seconds (chosen)."""
    cluster_poll_s: float = 1.0
    """How often the cluster's workers are counted while a result is awaited, seconds (chosen)."""
    cluster_patience_s: float = 120.0
    """A cluster without workers is given up after so many seconds: machines restart within that (chosen)."""
    canvas_mb: float = 48.0
    """Memory that a canvas keeps of its tiles, megabytes; tiles beyond it are on disk (chosen)."""
    live_canvas_mb: float = 512.0
    """Memory that the live map's real-time canvas keeps of its tiles, megabytes: with the tiles of all vehicles mapped
    a picture of 96 vehicles in turn is drawn in 0.6 instead of 0.9 ms (measured; 128 megabytes hold a third of them).
    The system can take these pages back."""
    tile_store_mb: float = 64.0
    """Memory that a drawing task keeps of the tiles that it writes, megabytes (chosen)."""
    working_pictures_mb: float = 160.0
    """Memory that a vehicle's refinement keeps of its pictures at working scale, megabytes (chosen)."""
    pictures_per_task: int = 64
    """Pictures that a drawing task reads, or copies to previews (chosen: its overhead is small then)."""
    ratios_at_once: int = 65_536
    """Places whose colours are compared at once (chosen for memory)."""
    fields_at_once: int = 2048
    """Pictures whose factors of colour are evaluated at once, 15 kB each (chosen for memory)."""
