"""The workspace's products: those of a batch run without seam lines, made in a worker from the journal."""

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gcs_plugin.daemon.jobs.solution_file import SolutionFile, read_solution
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.store.job_rows import latest_jobs
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.sortie_rows import completion_rows
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.compute.workers import peak_rss_mb
from orthoswarm.export.forms import FORMS, MapExport
from orthoswarm.export.tactical import places
from orthoswarm.export.tactical.places import Place
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Frame, Rejection, last_time
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame, Solution
from orthoswarm.raster.basemap import Basemap

if TYPE_CHECKING:
    from orthoswarm.mosaic.recorded_pose import Recorded

FORMATS: Final = tuple(name for name, form in FORMS.items() if form.daemon)
PRODUCTS: Final = ("cog", "gpkg")
"""The formats that are written without being asked for."""
_CONFIDENCE_STEP_M: Final = 1.25  # distance of the nodes on which tall things are looked at: theirs at 100 m height
_CONFIDENCE_NODES: Final = 2_000_000  # farther apart where there would be more (memory)
_MOST_JOBS: Final = 1000  # the latest ones
_OTHER_STAGES: Final = {
    "coarse: in flight": "coarse", "fine: neighbours together": "together", "final: tones": "tones",
}  # fmt: skip
_FILES: Final = {"realtime": "realtime.tif", "coarse": "coarse.tif", "fine": "orthoimage.tif"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportTask:
    """An export.

    Attributes:
        workspace: the daemon's folder. formats: some of FORMATS.
        canvases: layer -> its canvas's folder, those that there are. epsg, gsd_m: the area's.
        frames: all frames with their stages. reasons: (vehicle, image) -> why it was left out, and stages likewise.
        coarse, solutions: solution files of sorties placed in flight only, and of refined ones.
        basemap: the map, or None. fov_rad: theta-hat. facts: for the report. places: finds and vehicles.
        cells: picture of the coverage's cells (PNG), empty without an area.
    """

    workspace: Path
    formats: tuple[str, ...]
    canvases: dict[str, Path]
    epsg: int
    gsd_m: float
    frames: list[Frame]
    reasons: dict[tuple[str, str], str]
    coarse: list[Path]
    solutions: list[Path]
    basemap: Path | None
    fov_rad: float | None
    facts: dict[str, Any] = field(default_factory=dict)
    places: tuple[Place, ...] = ()
    cells: bytes = b""


def write_products(task: ExportTask) -> dict[str, str]:
    """Write COGs, frames.jsonl, footprints, report, and the other formats; gives format -> path in the workspace.

    Raises:
        InputError: there is no map yet.
        OrthoSwarmError: the disk is full.
    """
    from orthoswarm.export.product_files import write_frames, write_json
    from orthoswarm.mosaic.extent import solved_level
    from orthoswarm.refine.registration.map_offset import measure_map_offset
    from orthoswarm.report.page import put_section, write_page
    from orthoswarm.report.trust import headline

    out = task.workspace
    recorded = _recorded(task)
    made, area_ha = _pictures(task, last_time(p.frame for p in recorded.placed))
    if not made:
        raise InputError("there is no map yet; wait for pictures")
    refined_files = [read_solution(path) for path in task.solutions]
    refined = [file.solution for file in refined_files]
    solutions = [*(read_solution(path).solution for path in task.coarse), *refined]
    placed, rejected = _placements(task, recorded, solutions)
    offset = measure_map_offset(recorded.placed, placed)
    placed, level = _stated(placed, solutions)
    write_frames(out, placed, rejected, LocalGrid(task.epsg), level)
    report = _report(task, solutions, placed, rejected, level, assumed=recorded.warnings)
    report |= {"area_ha": area_ha, "until": "fine", "root": None}
    if refined:
        best = next(layer for layer in reversed(_FILES) if layer in task.canvases)
        report["trust"] = _trust(task, best, refined_files, level - solved_level(solutions))
        report["headline"] = headline(report)
    report["unrefined"] = _unrefined(placed, refined)
    report["map_offset_m"] = None if offset is None else offset.document()
    report["warnings"] += [] if offset is None else offset.warning()
    basemap = None if task.basemap is None else Basemap.open(task.basemap, task.epsg)
    report["against_map_m"] = write_page(out, report, placed, rejected=rejected, basemap=basemap, cells=task.cells)
    put_section(out, out)  # of the last comparison, until the next one
    write_json(out / "report.json", report)
    places.write_geojson(task.places, out / places.FILE)
    files = {"cog": made[-1], "gpkg": "footprints.gpkg"}
    others = [name for name in task.formats if name not in files]
    if others:
        files |= _converted(task, out / made[-1], others, placed)
    return files


def _pictures(task: ExportTask, time_s: float | None) -> tuple[list[str], float]:
    """A COG for each layer, the best one last, and the ground that the first shows, hectares.

    orthoimage.tif is there as soon as anything was refined.
    """
    import shutil

    from orthoswarm.export.atomic_file import atomic_write
    from orthoswarm.export.cog import write_cog
    from orthoswarm.mosaic.extent import drawn_window

    made: list[str] = []
    area_ha = 0.0
    for name, file in _FILES.items():
        if name not in task.canvases:
            continue
        with Canvas.open(task.canvases[name], writable=False) as canvas:
            if canvas.drawn[1] == 0:
                continue
            area_ha = area_ha or _drawn_ha(canvas)
            write_cog(
                _WithOverviews(canvas), task.workspace / file, window=drawn_window(canvas), threads=1, time_s=time_s
            )
        made.append(file)
    if task.solutions and made[-1:] == ["coarse.tif"]:  # without a map the orthoimage is the coarse product
        with atomic_write(task.workspace / "orthoimage.tif") as part:
            shutil.copyfile(task.workspace / "coarse.tif", part)
        made.append("orthoimage.tif")
    return made, area_ha


def _trust(task: ExportTask, layer: str, refined: list[SolutionFile], moved_m: float) -> dict[str, object]:
    """Write the ground, and how far a refined layer can be trusted, and return its figures.

    moved_m: by how much stated heights are higher than solved ones.
    """
    from orthoswarm.export.value_raster import GROUND, write_confidence, write_ground
    from orthoswarm.mosaic.confidence import cell_grid, confidence
    from orthoswarm.mosaic.extent import ground_of_nearest
    from orthoswarm.mosaic.visible_ground import nearest_cameras

    placed = [p for file in refined for p in file.solution.placed]
    gains = [file.gains.get(p.frame.image) for file in refined for p in file.solution.placed]
    paths = [np.array([p.camera.nadir for p in file.solution.placed]).reshape(-1, 2) for file in refined]
    terrain = ground_of_nearest(
        [file.terrain for file in refined], paths, max(float(p.camera.position[2]) for p in placed),
        step_m=_CONFIDENCE_STEP_M, most_nodes=_CONFIDENCE_NODES,
    )  # fmt: skip
    with Canvas.open(task.canvases[layer], writable=False) as canvas:
        grid, _ = cell_grid(canvas)
    shown = nearest_cameras([p.camera for p in placed], [p.weak for p in placed], grid, terrain)
    found = confidence(grid, shown, placed, terrain, gains)
    write_confidence(task.workspace / "confidence.tif", found)
    write_ground(task.workspace / GROUND, terrain.changed(lambda z: z + np.float32(moved_m)), task.epsg)
    return found.figures()


def _drawn_ha(canvas: Canvas) -> float:
    """Area drawn on a canvas, hectares."""
    row0, row1, col0, col1 = canvas.drawn
    drawn = 0
    for top in range(row0, row1, canvas.tile_px):
        drawn += int(np.count_nonzero(canvas.read(top, min(row1, top + canvas.tile_px), col0, col1)[..., 3]))
    return drawn * canvas.grid.gsd_m**2 / 1e4


class _WithOverviews:
    """A canvas written by another process; its overviews may be outdated, so reduced pixels are computed."""

    def __init__(self, canvas: Canvas) -> None:
        self.grid, self._canvas = canvas.grid, canvas

    def read_reduced(self, factor: int, row0: int, row1: int, col0: int, col1: int) -> Any:
        """See Canvas.read_reduced."""
        from orthoswarm.canvas.overviews import reduce_rgba

        if factor == 1:
            return self._canvas.read(row0, row1, col0, col1)
        out = np.zeros((row1 - row0, col1 - col0, 4), np.uint8)
        step = max(1, 512 // factor)  # in strips, for memory
        for top in range(row0, row1, step):
            bottom = min(row1, top + step)
            part = self._canvas.read(top * factor, bottom * factor, col0 * factor, col1 * factor)
            out[top - row0 : bottom - row0] = reduce_rgba(part, factor)
        return out


def _recorded(task: ExportTask) -> "Recorded":
    """All frames as recorded."""
    from orthoswarm.mosaic.recorded_pose import recorded_cameras

    ordered = sorted(task.frames, key=lambda f: (f.vehicle, f.time_s or 0.0))
    return recorded_cameras(ordered, LocalGrid(task.epsg), task.fov_rad)


def _placements(
    task: ExportTask, recorded: "Recorded", solutions: list[Solution]
) -> tuple[list[PlacedFrame], list[Rejection]]:
    """The latest placement of each frame."""
    best: dict[tuple[str, str], PlacedFrame] = {}
    for p in [*recorded.placed, *(p for s in solutions for p in s.placed)]:
        best[p.frame.vehicle, p.frame.image] = p
    reasons = {(r.vehicle, r.image): r.reason for r in recorded.rejected} | task.reasons
    placed = [replace(p, frame=_writable(p.frame)) for key, p in best.items() if key not in reasons]
    known = {(f.vehicle, f.image): _writable(f) for f in task.frames}
    left_out = ((known[key], why) for key, why in reasons.items() if key in known)
    return placed, [Rejection(f.image, why, f.vehicle, f.time_s) for f, why in left_out]


def _unrefined(placed: list[PlacedFrame], refined: list[Solution]) -> dict[str, int]:
    """Vehicle -> number of its pictures that no refinement has used, also none without a map."""
    frames = (_writable(p.frame) for solution in refined for p in solution.placed)
    used = {(frame.vehicle, frame.image) for frame in frames}
    return dict(Counter(p.frame.vehicle for p in placed if (p.frame.vehicle, p.frame.image) not in used))


def placements(task: ExportTask, solutions: list[Solution]) -> tuple[list[PlacedFrame], float]:
    """The latest placement of each frame, and the level of the ground below them, metres."""
    return _stated(_placements(task, _recorded(task), solutions)[0], solutions)


def _writable(frame: Frame) -> Frame:
    """A frame whose names are `writable`."""
    return replace(frame, image=writable(frame.image), vehicle=writable(frame.vehicle))


def writable(text: str) -> str:
    """A text that can be written in UTF-8 and by C libraries: half characters and NUL as what stands for them."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")


def _stated(placed: list[PlacedFrame], solutions: list[Solution]) -> tuple[list[PlacedFrame], float]:
    """The frames and the level of the ground below them as they are written."""
    from orthoswarm.mosaic.extent import from_takeoff, solved_level

    terrain = next((s.terrain for s in solutions if s.terrain is not None), None)
    frames, level = from_takeoff(placed, solved_level(solutions), terrain)
    return list(frames), level


def _report(
    task: ExportTask, solutions: list[Solution], placed: list[PlacedFrame], rejected: list[Rejection], level: float,
    *, assumed: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """The report; `assumed` are sentences on what the pictures' poses lack."""
    from orthoswarm.export.product_files import leg_rows, vehicle_rows
    from telemetry.photos.flight_checks import times_without_zone

    warnings = [*map(str, times_without_zone(task.frames)), *assumed, *(w for s in solutions for w in s.warnings)]
    if task.basemap is None:
        warnings.append("there is no basemap: the orthoimage lies where the drones' receivers say")
    for stage in task.facts.get("stages", []):
        if stage["name"] == "realtime":
            stage["items"] = len(placed)
    return {
        "frames": {"input": len(placed) + len(rejected), "used": len(placed), "rejected": len(rejected)},
        "vehicles": vehicle_rows(solutions, placed), "legs": leg_rows(solutions), "ground_z_m": level,
        "refine": "swarm" if solutions else "none", "warnings": list(dict.fromkeys(warnings)), "epsg": task.epsg,
        "gsd_m": task.gsd_m, "basemap": None if task.basemap is None else task.basemap.name, **task.facts,
    }  # fmt: skip


def _converted(task: ExportTask, picture: Path, formats: list[str], placed: list[PlacedFrame]) -> dict[str, str]:
    """The other formats, in the workspace's folder `export`."""
    paths = {(p.frame.vehicle, p.frame.image): p.frame.path for p in placed}
    what = MapExport(
        folder=task.workspace, dest=task.workspace / "export", layer=picture.stem, places=task.places,
        find=lambda row: paths.get((row["vehicle"], row["image"])),
    )  # fmt: skip
    return {name: FORMS[name].write(what).relative_to(task.workspace).as_posix() for name in formats}


@dataclass(frozen=True, slots=True)
class RunFacts:
    """The daemon's own facts for the report."""

    journal: Journal
    started: float
    pools: Sequence[WorkerPool]

    def document(self) -> dict[str, Any]:
        """Stage timings from jobs, completions, and resource usage, as JSON values."""
        jobs, pools = latest_jobs(self.journal, _MOST_JOBS), [pool.usage() for pool in self.pools]
        wall_s, cpu_s = time.time() - self.started, time.process_time()
        stages = [{"name": "realtime", "wall_s": wall_s, "cpu_s": cpu_s, "items": 0}]  # counted in the report
        for job in jobs:
            if job.kind == "refine" and job.state == "done":
                stages += _summed(f"{job.detail.get('layer', 'fine')}: {job.vehicle}", [job.detail])
        placing = [job for job in jobs if "frames" in job.detail]
        for name, kind in _OTHER_STAGES.items():
            stages += _summed(name, [job.detail for job in placing if job.kind == kind])
        document = {
            "stages": stages, "wall_s": wall_s, "cpu_s": cpu_s + sum(pool.cpu_s for pool in pools),
            "peak_rss_mb": peak_rss_mb() + sum(pool.peak_rss_mb for pool in pools),
            "completions": completion_rows(self.journal),
        }  # fmt: skip
        return dict(json.loads(json.dumps(document)))


def _summed(name: str, details: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The summed timing of some jobs, by what is kept of each; nothing of no job."""
    wall_s, cpu_s = (sum(d.get(key, 0.0) for d in details) for key in ("seconds", "solve_cpu_s"))
    items = sum(d.get("frames", 0) for d in details)
    return [{"name": name, "wall_s": wall_s, "cpu_s": cpu_s, "items": items}] if details else []
