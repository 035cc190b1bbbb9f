"""The surface model of a run (`--surface`)."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from orthoswarm.batch.run_state import RunContext, RunState
from orthoswarm.export.surface_file import write_surface
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.placement import PlacedFrame, Refinement, Terrain
from orthoswarm.mosaic.takeoff_altitude import TakeoffLevel, takeoff_levels
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
    scale_sigma, common_m = _common_errors(placed, terrain, refinement, levels)
    try:
        with run.clock.stage("final: surface", len(placed)):
            model = surface_model(
                placed, terrain, state.grid.epsg, run.space.scratch("surface"), config=run.options.config.stereo,
                run=run.drawers.map,
                progress=partial(run.progress, "matching the surface"),
            )  # fmt: skip
            write_surface(path, model, altitude, common_m)
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
        "common_sigma_m": None if common_m is None else round(common_m, 2),
        "scale_sigma": None if scale_sigma is None else round(scale_sigma, 4),
        "takeoff_altitude_m": None if altitude is None else round(altitude, 2),
    }


def _common_errors(
    placed: Sequence[PlacedFrame], terrain: Terrain, refinement: Refinement, levels: Mapping[str, TakeoffLevel]
) -> tuple[float | None, float | None]:
    """What is wrong with all heights alike, which no comparison of pairs shows.

    Over level ground pictures hardly tell a longer focal length from a higher flight: the ground's distance from the
    cameras is as uncertain as the focal length, df / f = dfov / sin(fov). Altitudes have the receivers' error besides.

    Returns:
        One sigma of the scale of heights, as a share, and of all heights together, metres; None where not known.
    """
    known = {s.vehicle: s.fov_sigma_deg for s in refinement.fine if math.isfinite(s.fov_sigma_deg)}
    own = [p for p in placed if p.frame.vehicle in known]
    if not own:
        return None, None
    share = np.array([math.radians(known[p.frame.vehicle]) / math.sin(p.camera.lens.fov_rad) for p in own])
    over_ground = np.array([p.camera.position[2] for p in own]) - terrain.height(
        np.array([p.camera.nadir for p in own])
    )
    of_zero = statistics.median(level.sigma_m for level in levels.values()) if levels else 0.0
    return float(np.median(share)), math.hypot(float(np.median(share * over_ground)), of_zero)
