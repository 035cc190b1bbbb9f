"""The report of a run: frames.jsonl, footprints, report.json and the report's page."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from orthoswarm.batch.run_state import COARSE, ORTHOIMAGE, PRODUCTS, REALTIME, SEAMLINES, RunContext, RunState
from orthoswarm.config import changes
from orthoswarm.evaluation.checkpoints import evaluate_checkpoints
from orthoswarm.evaluation.independent_points import control_rows
from orthoswarm.export.catalog.tiled_raster import remove_collection, remove_product, tiles_of
from orthoswarm.export.product_files import (
    image_root,
    iso_time,
    leg_rows,
    vehicle_rows,
    write_frames,
    write_json,
)
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import PlacedFrame, Refinement
from orthoswarm.mosaic.extent import from_takeoff, ground_level, solved_level
from orthoswarm.report.page import write_page
from orthoswarm.stores.addresses import address_of


def write_products(
    run: RunContext, state: RunState, placed: list[PlacedFrame], refinement: Refinement | None
) -> dict[str, Any]:
    """frames.jsonl, footprints and the report."""
    for name in PRODUCTS:  # left by an earlier run with other options
        if name not in _made(run, state.fault is not None):
            remove_product(run.out, name)
    remove_collection(run.out)
    solved = refinement is not None and state.terrain is refinement.terrain
    level = solved_level(refinement.fine) if refinement and solved else ground_level(placed, state.terrain)
    stated, z = from_takeoff(placed, level, state.terrain)
    surface = None
    if run.options.surface is not None:
        from orthoswarm.batch.surface_product import make_surface  # a fifth of a second that other runs do without

        surface = make_surface(run, state, stated, z - level, refinement)
    with run.clock.stage("final: report", len(placed)) as stage:
        write_frames(run.out, stated, list(state.rejected.values()), state.grid, z, covariance=run.options.covariance)
        report = _report(run, state, placed, refinement, z) | {"surface": surface}
        _add_checkpoints(run, state, report, z)
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
    names = set(PRODUCTS)
    if run.options.until != "fine" or faulty:
        names -= {ORTHOIMAGE, SEAMLINES}
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
        "warnings": list(dict.fromkeys(state.warnings)),
        "epsg": state.grid.epsg,
        "gsd_m": state.gsd_m,
        "area_ha": state.drawn.area_m2 / 1e4,
        "covered_share": state.drawn.covered_share,
        "drawn_twice_share": state.drawn.twice_share,
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
