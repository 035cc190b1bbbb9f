"""The report of a run: frames.jsonl, footprints, report.json and the report's page."""

import math
import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from orthoswarm.batch.run_state import (
    COARSE,
    CONFIDENCE,
    ORTHOIMAGE,
    PRODUCTS,
    REALTIME,
    SEAMLINES,
    UNREFERENCED,
    RunContext,
    RunState,
)
from orthoswarm.config import changes
from orthoswarm.evaluation.checkpoints import control_rows, evaluate_checkpoints
from orthoswarm.export.catalog.tiled_raster import remove_collection, remove_product, tiles_of
from orthoswarm.export.product_files import (
    image_root,
    iso_time,
    leg_rows,
    vehicle_rows,
    write_frames,
    write_json,
)
from orthoswarm.export.temperature import TEMPERATURE
from orthoswarm.export.value_raster import GROUND, write_ground
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.placement import PlacedFrame, Refinement, Terrain
from orthoswarm.mosaic.extent import from_takeoff, ground_level, solved_level
from orthoswarm.mosaic.takeoff_altitude import TakeoffLevel, takeoff_levels
from orthoswarm.report.page import write_page
from orthoswarm.report.trust import headline
from orthoswarm.stores.addresses import address_of


def write_products(
    run: RunContext, state: RunState, placed: list[PlacedFrame], refinement: Refinement | None
) -> dict[str, Any]:
    """frames.jsonl, footprints and the report."""
    for name in (*PRODUCTS, UNREFERENCED, TEMPERATURE):  # left by an earlier run with other options
        if name not in _made(run, state.fault is not None):
            remove_product(run.out, name)
    remove_collection(run.out)
    solved = refinement is not None and state.terrain is refinement.terrain
    level = solved_level(refinement.fine) if refinement and solved else ground_level(placed, state.terrain)
    stated, z = from_takeoff(placed, level, state.terrain)
    surface = None
    if run.options.surface is not None:
        surface = make_surface(run, state, stated, z - level, refinement)
    if state.terrain is None:  # left by an earlier run
        (run.out / GROUND).unlink(missing_ok=True)
    elif GROUND in _made(run, state.fault is not None):
        write_ground(run.out / GROUND, state.terrain.changed(lambda h: h + np.float32(z - level)), state.grid.epsg)
    with run.clock.stage("final: report", len(placed)) as stage:
        write_frames(run.out, stated, list(state.rejected.values()), state.grid, z, covariance=run.options.covariance)
        report = _report(run, state, placed, refinement, z) | {"surface": surface}
        _add_checkpoints(run, state, report, z)
        report["headline"] = headline(report)
        left_out = list(state.rejected.values())
        try:
            report["against_map_m"] = write_page(run.out, report, stated, rejected=left_out, basemap=state.basemap)
        except InputError as error:  # a map may be damaged where only the report reads it
            report["warnings"].append(f"the report's pictures are without the map: {error}")
            report["against_map_m"] = write_page(run.out, report, stated, rejected=left_out, basemap=None)
    wall, cpu, memory = run.clock.totals()
    report |= {"wall_s": wall, "cpu_s": cpu, "peak_rss_mb": memory}
    report["stages"].append(asdict(stage))
    if any(tiles_of(run.out, name) for name in (REALTIME, COARSE, ORTHOIMAGE)):
        from orthoswarm.export.catalog.stac_collection import write_collection

        report["tiles"] = {name: len(tiles_of(run.out, name)) for name in (REALTIME, COARSE, ORTHOIMAGE)}
        write_json(run.out / "report.json", report)  # which the collection quotes
        write_collection(run.out, iso_time(time.time()) or "")
    write_json(run.out / "report.json", report)
    return report


def _add_checkpoints(run: RunContext, state: RunState, report: dict[str, Any], ground_z_m: float) -> None:
    """The errors at surveyed points, where the run was given some; from the placements that were just written."""
    report["checkpoints"] = None
    table = run.options.checkpoints
    if table is None:
        return
    try:
        accuracy = evaluate_checkpoints(
            run.out, table, run.options.pixel_scale, ground_z_m, control=state.control_points
        )
        report["checkpoints"] = accuracy.figures()
        report["warnings"] += [f"check{finding}" for finding in accuracy.findings]
    except InputError as error:
        report["warnings"].append(f"the checkpoints could not be measured: {error}")


def _made(run: RunContext, faulty: bool) -> set[str]:
    names = set(PRODUCTS) if run.options.temperature is None else {*PRODUCTS, TEMPERATURE}
    if run.options.until != "fine" or faulty:
        names -= {ORTHOIMAGE, SEAMLINES, CONFIDENCE, GROUND}
    if run.options.until == "realtime" or faulty:
        names.discard(COARSE)
    return names


def _report(
    run: RunContext, state: RunState, placed: Sequence[PlacedFrame], refinement: Refinement | None, ground_z_m: float
) -> dict[str, Any]:
    """The content of report.json so far."""
    solutions = refinement.fine if refinement else []
    wall, cpu, memory = run.clock.totals()
    count, left_out = len(placed), len(state.rejected)
    reasons = Counter(r.reason for r in state.rejected.values())
    return {
        "frames": {"input": count + left_out, "used": count, "rejected": left_out},
        "left_out": dict(reasons.most_common()),
        "vehicles": vehicle_rows(solutions, placed),
        "legs": leg_rows(solutions),
        "stages": [asdict(s) for s in run.clock.stages],
        "wall_s": wall,
        "cpu_s": cpu,
        "peak_rss_mb": memory,
        "ground_z_m": ground_z_m,
        "refine": run.options.refine if solutions else "none",
        "warnings": list(dict.fromkeys(state.ingest.warnings if run.options.unreferenced else state.warnings)),
        "epsg": state.grid.epsg,
        "gsd_m": state.gsd_m,
        "area_ha": state.drawn.area_m2 / 1e4,
        "covered_share": state.drawn.covered_share,
        "drawn_twice_share": state.drawn.twice_share,
        "trust": dict(state.trust),
        "basemap": address_of(run.options.basemap) if run.options.basemap and state.basemap else None,
        "map_offset_m": None if state.map_offset is None else state.map_offset.document(),
        "control_points": control_rows(state.control_points),
        "control_offset_m": None if state.control_offset is None else state.control_offset.document(),
        "control": None if state.control is None else state.control.document(),
        "until": run.options.until,
        "config": changes(run.options.config),
        "map_lean_m_per_m": list(solutions[0].map_lean) if solutions else [0.0, 0.0],
        "root": image_root(state.ingest.frames),
        **({"equation_5": dict(refinement.equation_5)} if refinement and refinement.equation_5 else {}),
    }


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
    from orthoswarm.export.value_raster import write_surface  # a fifth of a second that other runs do without
    from orthoswarm.stereo.surface_model import surface_model

    path = run.options.surface
    assert path is not None
    if refinement is None:
        state.warnings.append("the surface model was not made: the pictures could not be refined")
        return None
    terrain = (state.terrain or Terrain.flat()).changed(lambda z: z + np.float32(moved_m))
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
