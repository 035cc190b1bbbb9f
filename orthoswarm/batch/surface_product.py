"""The surface model of a run (`--surface`)."""

import statistics
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from orthoswarm.batch.run_state import RunContext, RunState
from orthoswarm.export.surface_file import write_surface
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.placement import PlacedFrame, Refinement, Terrain
from orthoswarm.mosaic.takeoff_altitude import takeoff_levels
from orthoswarm.stereo.surface_model import surface_model


def make_surface(
    run: RunContext, state: RunState, placed: Sequence[PlacedFrame], moved_m: float, refinement: Refinement | None
) -> dict[str, Any] | None:
    """Write the file of --surface; returns its figures for the report, None if it could not be made.

    A failure becomes a warning, since the orthoimage is valid without it.

    Args:
        run, state: the run; its terrain is on the level of the cameras before they were moved.
        placed: the frames with the stated heights. moved_m: by how much these were moved.
        refinement: what placed them; None if they lie as recorded.
    """
    path = run.options.surface
    assert path is not None
    if refinement is None:
        state.warnings.append("the surface model was not made: the pictures could not be refined")
        return None
    terrain = state.terrain or Terrain.flat()
    terrain = replace(
        terrain, z=terrain.z + np.float32(moved_m), bare=None if terrain.bare is None else terrain.bare + moved_m
    )
    levels = takeoff_levels(placed)
    altitude = statistics.median(level.altitude_m for level in levels.values()) if levels else None
    try:
        with run.clock.stage("final: surface", len(placed)):
            model = surface_model(
                placed, terrain, state.grid.epsg, run.space.scratch("surface"), run=run.drawers.map,
                progress=partial(run.progress, "matching the surface"),
            )  # fmt: skip
            write_surface(path, model, altitude)
    except OrthoSwarmError as error:
        state.warnings.append(f"the surface model was not made: {error}")
        return None
    run.space.clear_scratch()
    known = np.isfinite(model.height_m)
    return {
        "file": str(path),
        "cell_m": model.grid.gsd_m,
        "known_ha": round(float(known.sum()) * model.grid.gsd_m**2 / 1e4, 3),
        "median_sigma_m": round(float(np.median(model.sigma_m[known])), 3) if known.any() else None,
        "takeoff_altitude_m": None if altitude is None else round(altitude, 2),
    }
