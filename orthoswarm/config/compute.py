"""Workers and memory. These change how long a run takes, never its products."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeConfig:
    """Workers and memory. These change how long a run takes, never its products."""

    alone_mpx: float = 20.0
    """Pictures of no more megapixels together are mapped in one process where the user names no number of workers: each
    other process takes 1.1 to 2 s to start, 65 photos of 640 x 480 pixels 5 s (measured on two cores)."""
    queue_per_process: int = 4
    """Items begun or done ahead of the one that is waited for, for each process (chosen; bounds memory)."""
    idle_share: float = 0.1
    """Tasks that can be halved are, where processes would be idle for more than this share of the work, being too few
    (chosen: halves cost 5 % of CPU)."""
    trim_after_s: float = from_zero(0.5)
    """After a task that took more CPU seconds unused memory goes back to the system (chosen)."""
    cluster_connect_s: float = 20.0
    """Time to reach a Dask scheduler, seconds (chosen)."""
    cluster_queue_per_worker: int = 3
    """Items sent to a cluster for each worker, so that none waits for the network (chosen)."""
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
    map_pixels_at_once: int = 8_000_000
    """Pixels of a map read at once (chosen for memory)."""
