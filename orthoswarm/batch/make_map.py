"""One call from frames to a map, for programs that use OrthoSwarm as a library."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from orthoswarm.batch.pipeline import MapOptions, run
from orthoswarm.compute.workers import prepare_process, workers
from orthoswarm.model.frame import Frame, Ingest
from orthoswarm.model.task_runner import Progress


def make_map(
    frames: Ingest | Sequence[Frame],
    out: Path,
    options: MapOptions | None = None,
    *,
    processes: int | None = 1,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Make orthoimage, refined poses and report of pictures, as `orthoswarm mosaic` does.

    Args:
        frames: the pictures with their recorded poses; what `telemetry.load` gives, or frames of your own.
        out: output folder; a run that was interrupted there goes on.
        options: basemap, ground pixel and so on, see MapOptions.
        processes: how many compute at once, None for one a core. With more than one the calling script needs the guard
            `if __name__ == "__main__":`, as always with processes. The products do not depend on it.
        progress: called during the work with what is done, how many, and of how many.

    Returns:
        The content of report.json.

    Raises:
        InputError: no picture has a position, or a file of the options cannot be used.
        OrthoSwarmError: nothing could be made of them.
    """
    prepare_process()
    ingest = frames if isinstance(frames, Ingest) else Ingest(list(frames), [], [])
    options = options or MapOptions()
    pool = workers(processes)
    try:
        return run(lambda _: ingest, out, options, pool, progress or (lambda *_: None))
    finally:
        pool.close()
