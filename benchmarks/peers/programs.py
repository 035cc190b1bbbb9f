"""Comparison with other programs on the same photos (the paper's Table I): accuracy, time, memory.

Each program runs in its own virtual environment, made on first use; none of them is a dependency. All, this one
included, get the same photos, number of threads and limit, and are measured in the same way.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gcs_plugin.bench.accuracy import judged, true_orthoimage
from gcs_plugin.bench.benchmark_runs import (
    check_set,
    described,
    error_line,
    label,
    link_photos,
    machine,
    mosaic_command,
    pictures,
    read_result,
    share,
    text,
    write_result,
)
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.model.errors import InputError, OrthoSwarmError

SUCCESS = 0.9
"""A map succeeds if at least this share of the photographed ground is within a metre of its true position."""
_INSIDE = Path(__file__).parent / "inside"
Cell = tuple[str, Path | None]
"""Title above a map, and its thumbnail; None where there is no map."""
_PROC = Path("/proc")
_MEASURED_EVERY_S = 0.25
_WALL_FACTOR = 20.0  # a program may wait so many times its limit of CPU time


@dataclass(frozen=True, slots=True)
class PeerJob:
    """One program on one set.

    Attributes:
        folder: the set. photos: those to use, in their sub-folders. flat: the same, all in one folder.
        out: an empty folder for its results. threads: how many it may use.
    """

    folder: Path
    photos: Path
    flat: Path
    out: Path
    threads: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """A program to compare with.

    Attributes:
        title: its name in the table.
        packages: pip requirements of its environment; empty for this program itself.
        command: the command line of a job, from the job and the environment's folder of executables.
        product: makes the GeoTIFF that is evaluated from the program's results; returns its path and the number of
            pictures in it (None where unknown).
        georeferenced: the source of its georeference, for the table.
        placed: False for a program without georeference; only the internal geometry of its map is evaluated.
    """

    title: str
    packages: tuple[str, ...]
    command: Callable[[PeerJob, Path], list[str]]
    product: Callable[[PeerJob], tuple[Path, int | None]]
    georeferenced: str
    placed: bool = True


# -- the programs -------------------------------------------------------------------------------------------------
def _own(refine: str) -> Program:
    def command(job: PeerJob, _: Path) -> list[str]:
        return mosaic_command(
            job.photos, job.folder / "basemap.tif", job.out / "map", ["--refine", refine], job.threads
        )

    def product(job: PeerJob) -> tuple[Path, int | None]:
        report = read_result(job.out / "map" / "report.json") or {}
        return job.out / "map" / "orthoimage.tif", report.get("frames", {}).get("used")

    return Program(
        title=f"OrthoSwarm `{refine}`", packages=(), command=command, product=product, georeferenced="yes, on the map"
    )


def _orthomosaic_command(job: PeerJob, programs: Path) -> list[str]:
    options = ["--workers", str(job.threads), "--backend", "cpu", "--no-preview"]
    return [str(programs / "orthomosaic"), str(job.flat), "-o", str(job.out / "ortho.tif"), *options]


def _orthomosaic_product(job: PeerJob) -> tuple[Path, int | None]:
    report = read_result(job.out / "ortho_report.json") or {}
    if not report.get("georeferenced", True):
        raise OrthoSwarmError("it made a picture without georeference")
    return job.out / "ortho.tif", report.get("images_used")


def _script(name: str) -> Callable[[PeerJob, Path], list[str]]:
    def command(job: PeerJob, programs: Path) -> list[str]:
        return [str(programs / "python"), str(_INSIDE / name), str(job.photos), str(job.out), str(job.threads)]

    return command


def _stitched(job: PeerJob) -> tuple[Path, int | None]:
    from benchmarks.peers.georeferencing import lay_on_reference

    out = job.out / "laid.tif"  # the most favourable georeference that it could get
    lay_on_reference(job.out / "picture.png", job.folder / "truth" / "reference.tif", out)
    return out, (read_result(job.out / "outcome.json") or {}).get("used")


def _pasted(job: PeerJob) -> tuple[Path, int | None]:
    import numpy as np

    import telemetry
    from benchmarks.peers.georeferencing import placed_models
    from gcs_plugin.bench.accuracy import paste
    from orthoswarm.model.geo import LocalGrid, area_epsg
    from orthoswarm.model.placement import PlacedFrame, Terrain

    frames = {f.image: f for f in telemetry.load([job.photos]).frames}
    fixes = {name: f.fix for name, f in frames.items() if f.fix.height_m is not None}
    epsg = area_epsg([f.lat_deg for f in fixes.values()], [f.lon_deg for f in fixes.values()])
    grid = LocalGrid(epsg)
    recorded = {
        name: np.array([*np.ravel(grid.to_grid(f.lat_deg, f.lon_deg)), f.height_m], float) for name, f in fixes.items()
    }
    cameras, level = placed_models(read_result(job.out / "poses.json") or [], recorded)
    placed = [PlacedFrame(frames[name], camera, "fine", 0.0) for name, camera in sorted(cameras.items())]
    return paste(placed, Terrain.flat(level), epsg, job.out), len(placed)


PROGRAMS = {
    "swarm": _own("swarm"),
    "paper": _own("paper"),
    "pyorthomosaic": Program(
        title="pyOrthomosaic", packages=("pyOrthomosaic==0.9.3",), command=_orthomosaic_command,
        product=_orthomosaic_product, georeferenced="yes, by GPS tags",
    ),
    "stitcher": Program(
        title="OpenCV Stitcher, scans", packages=("opencv-python-headless>=4.10,<5",), command=_script("stitch.py"),
        product=_stitched, georeferenced="no", placed=False,
    ),
    "pycolmap": Program(
        title="pycolmap, pasted on flat ground", packages=("pycolmap==4.2.1",), command=_script("colmap.py"),
        product=_pasted, georeferenced="yes, by a similarity to the GPS tags",
    ),
}  # fmt: skip


# -- running ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True, kw_only=True)
class PeerSettings:
    """How to compare.

    Attributes:
        programs: keys of PROGRAMS. out: folder for results. environments: folder of the virtual environments.
        limit_s: CPU seconds a program may use. every: use every n-th photo of a vehicle. threads: for each program.
        keep_maps: keep what the programs made.
    """

    programs: tuple[str, ...]
    out: Path
    environments: Path
    limit_s: float
    every: int
    threads: int
    keep_maps: bool

    def path(self, folder: Path, name: str, suffix: str) -> Path:
        """Path of a result of one program on one set."""
        thin = f"-every{self.every}" if self.every > 1 else ""
        return self.out / f"{folder.absolute().name}-{name}{thin}{suffix}"


def run_peers(sets: Sequence[Path], settings: PeerSettings) -> dict[str, Any]:
    """Run every program on every set; results that exist in the output folder are not computed again.

    Raises:
        InputError: if a folder is not a data set with truth, or a program is not known.
    """
    unknown = set(settings.programs) - set(PROGRAMS)
    if unknown or not settings.programs:
        raise InputError(f"--programs accepts {', '.join(PROGRAMS)}; give one or more, separated by commas")
    for folder in sets:
        check_set(folder, truth=True)
    rows = []
    for folder in sets:
        ceiling = _result(folder, "truth", settings)
        for name in settings.programs:
            rows.append(described(folder) | with_verdict(_result(folder, name, settings), ceiling))
        rows.append(described(folder) | with_verdict(ceiling, ceiling))
    return {"machine": machine(), "limit_s": settings.limit_s, "threads": settings.threads, "rows": rows}


def _result(folder: Path, name: str, settings: PeerSettings) -> dict[str, Any]:
    path = settings.path(folder, name, ".json")
    row = read_result(path)
    if row is None:
        print(f"{folder.name}: {name}", file=sys.stderr, flush=True)
        row = _ceiling(folder, settings) if name == "truth" else _row(folder, name, settings)
        row |= {"program": name, "every": settings.every}
        write_result(path, row)
    found: dict[str, Any] = row
    return found


def thinned(folder: Path, every: int) -> list[Path]:
    """Every n-th photo of each vehicle of a set."""
    by_folder: dict[Path, list[Path]] = {}
    for photo in pictures(folder / "photos"):
        by_folder.setdefault(photo.parent, []).append(photo)
    return [photo for photos in by_folder.values() for photo in photos[::every]]


def _ceiling(folder: Path, settings: PeerSettings) -> dict[str, Any]:
    """The map from the true poses of the same photos: the best result that can be measured."""
    photos, out = settings.out / "photos", settings.out / "run"
    chosen = thinned(folder, settings.every)
    link_photos(chosen, folder / "photos", photos)
    shutil.rmtree(out, ignore_errors=True)
    row = true_orthoimage(folder, out, photos) | {"photos": len(chosen)}
    row |= judged(out / "orthoimage.tif", folder) | {"used": row["frames"]}
    _picture(out / "orthoimage.tif", settings.path(folder, "truth", ".jpg"))
    _remove(settings, photos, out)
    return row


def _row(folder: Path, name: str, settings: PeerSettings) -> dict[str, Any]:
    """One program on one set; a failure is a row with its message."""
    program, base = PROGRAMS[name], settings.out
    chosen = thinned(folder, settings.every)
    job = PeerJob(folder.absolute(), base / "photos", base / "flat", base / "run" / name, settings.threads)
    link_photos(chosen, folder / "photos", job.photos)
    link_photos(chosen, folder / "photos", job.flat, flat=True)
    shutil.rmtree(job.out, ignore_errors=True)
    job.out.mkdir(parents=True)
    row: dict[str, Any] = {"photos": len(chosen)}
    log = settings.path(folder, name, ".log")
    try:
        programs = environment(name, settings.environments) if program.packages else Path(sys.executable).parent
        row["version"] = _versions(programs, program)
        used = run_measured(
            program.command(job, programs), log, settings.limit_s, _threads(job.threads), job.out / "stdout"
        )
        row |= {"wall_s": used.wall_s, "cpu_s": used.cpu_s, "peak_rss_mb": used.peak_rss_mb}
        if used.code is None:
            raise OrthoSwarmError(f"stopped at the limit of {settings.limit_s:.0f} CPU s")
        if used.code:
            raise OrthoSwarmError(error_line(log.read_text(encoding="utf-8", errors="replace")))
        product, row["used"] = program.product(job)
        _picture(product, settings.path(folder, name, ".jpg"))
        if not program.placed:
            row["shape"] = judged(product, folder)
        else:
            row |= judged(product, folder)
            row["shape"] = _shape(product, job) if program.packages else None
    except OrthoSwarmError as error:
        row["error"] = str(error)
    _remove(settings, job.photos, job.flat, job.out)
    return row


def _shape(product: Path, job: PeerJob) -> dict[str, Any] | None:
    """The figures of a map after registration on the truth by one homography; None where that fails."""
    from benchmarks.peers.georeferencing import lay_on_reference

    laid = job.out / "shape.tif"
    try:
        lay_on_reference(product, job.folder / "truth" / "reference.tif", laid)
        return judged(laid, job.folder)
    except OrthoSwarmError:
        return None


def _remove(settings: PeerSettings, *folders: Path) -> None:
    for folder in folders:
        if not settings.keep_maps:
            shutil.rmtree(folder, ignore_errors=True)


def _threads(count: int) -> dict[str, str]:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    return {name: str(count) for name in names}


def environment(name: str, root: Path) -> Path:
    """The folder of executables of a program's own virtual environment, made if missing.

    Raises:
        OrthoSwarmError: if it cannot be installed, with pip's message.
    """
    folder = (root / name).absolute()
    programs = folder / "bin"
    if (folder / "made").exists():
        return programs
    print(f"making an environment with {' '.join(PROGRAMS[name].packages)}", file=sys.stderr, flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    for command in (
        [sys.executable, "-m", "venv", str(folder)],
        [str(programs / "python"), "-m", "pip", "install", "-q", *PROGRAMS[name].packages],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OrthoSwarmError(f"it could not be installed: {error_line(done.stderr)}")
    (folder / "made").touch()
    return programs


def _versions(programs: Path, program: Program) -> str:
    """The version of a program that is installed in its environment."""
    if not program.packages:
        from orthoswarm import __version__

        return __version__
    name = program.packages[0].split("=")[0].split(">")[0]
    code = f"import importlib.metadata as m; print(m.version({name!r}))"
    done = subprocess.run([str(programs / "python"), "-c", code], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def _picture(product: Path, out: Path) -> None:
    """Write a thumbnail of a map on white."""
    import numpy as np
    import rasterio
    from PIL import Image

    with rasterio.open(product) as file:
        scale = max(1.0, max(file.width, file.height) / 900.0)
        shape = (max(1, round(file.height / scale)), max(1, round(file.width / scale)))
        data = file.read([1, 2, 3], out_shape=(3, *shape), resampling=rasterio.enums.Resampling.average)
        drawn = file.dataset_mask(out_shape=shape) > 0
    thumbnail = Image.fromarray(np.moveaxis(np.where(drawn, data, 255), 0, -1).astype(np.uint8))
    with atomic_write(out) as part:
        thumbnail.save(part, "JPEG", quality=85)


# -- judging ------------------------------------------------------------------------------------------------------
def with_verdict(row: dict[str, Any], ceiling: dict[str, Any]) -> dict[str, Any]:
    """A row with `right_share`, `shape_share` and `succeeded`.

    `right_share` is the ground within a metre of its true position, as a share of the ground covered by a map from the
    true poses of the same photos, so that missing ground counts like wrong ground. `shape_share` is the same after
    registration on the truth by one homography, where that was done.
    """
    if "error" in row or not ceiling.get("blocks"):
        return row | {"succeeded": False}

    def right(figures: dict[str, Any] | None) -> float | None:
        if not figures or "blocks" not in figures:
            return None
        return float(min(1.0, figures["share_within_1m"] * figures["blocks"] / ceiling["blocks"]))

    placed, shape = right(row), right(row.get("shape"))
    verdict = {"right_share": placed, "shape_share": shape}
    return row | verdict | {"succeeded": (placed if placed is not None else shape or 0.0) >= SUCCESS}


def peers_sheet(result: dict[str, Any], settings: PeerSettings, out: Path) -> None:
    """Draw the maps of all programs side by side, one row per set."""
    by_set: dict[str, list[tuple[str, Path | None]]] = {}
    for row in result["rows"]:
        title = PROGRAMS[row["program"]].title if row["program"] in PROGRAMS else "true poses"
        picture = settings.path(Path(row["set"]), row["program"], ".jpg")
        cell = (verdict(title, row), None if "error" in row else picture)
        by_set.setdefault(label(row), []).append(cell)
    contact_sheet(list(by_set.items()), out)


def peers_table(result: dict[str, Any]) -> str:
    """The result as a Markdown table."""
    lines = [
        f"Machine: {result['machine']}; {result['threads']} thread(s) and {result['limit_s']:.0f} CPU seconds for each "
        f"program. Succeeded: at least {SUCCESS:.0%} of the ground that the photos show lies within 1 m of its place.",
        "",
        "| set | program | photos in the map | georeferenced | succeeded | within 1 m, of all ground "
        "| the same, its shape alone | median m | 95 % m | not found | CPU s | wall s | memory MB |",
        "|---" * 13 + "|",
    ]
    lines += [_line(row) for row in result["rows"]]
    return "\n".join(lines) + "\n"


def _line(row: dict[str, Any]) -> str:
    program = PROGRAMS.get(row["program"])
    name = program.title if program else "true poses (the ceiling)"
    if program and program.packages and row.get("version"):
        head, comma, rest = name.partition(",")
        name = f"{head} {row['version']}{comma}{rest}"
    thin = f", 1 of {row['every']} photos" if row["every"] > 1 else ""
    used = row.get("used")
    figures = row if "median_m" in row else row.get("shape") or {}
    costs = [text(row.get(k), 0) for k in ("cpu_s", "wall_s", "peak_rss_mb")]
    if "error" in row:
        middle = [f"- of {row['photos']}", "-", f"no: {row['error'].replace('|', '/')}", *"-----"]
    else:
        middle = [
            f"{'-' if used is None else used} of {row['photos']}",
            program.georeferenced if program else "yes",
            ("yes" if row["succeeded"] else "no") + ("" if row["right_share"] is not None else " (its shape)"),
            share(row["right_share"]),
            share(row["shape_share"]),
            text(figures["median_m"], 2),
            text(figures["p95_m"], 2),
            share(figures["unmatched_share"]),
        ]
    return f"| {label(row)}{thin} | {name} | " + " | ".join(middle + costs) + " |"


def contact_sheet(rows: Sequence[tuple[str, Sequence[Cell]]], out: Path) -> None:
    """Draw rows of maps, one row for each set.

    Args:
        rows: the name of each set and its maps.
        out: a JPEG.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from PIL import Image

    columns = max(len(cells) for _, cells in rows)
    size = (2.6 * columns, 3.4 * len(rows))
    figure, grid = pyplot.subplots(len(rows), columns, figsize=size, squeeze=False, layout="constrained")
    for axes_of_row, (name, cells) in zip(grid, rows, strict=True):
        axes_of_row[0].set_ylabel(name, fontsize=8)
        for axes in axes_of_row:
            axes.set(xticks=[], yticks=[], frame_on=False)
        for axes, (title, picture) in zip(axes_of_row, cells, strict=False):
            axes.set_title(title, fontsize=8)
            if picture is not None and picture.exists():
                with Image.open(picture) as image:
                    axes.imshow(image.convert("RGB"))
            else:
                axes.text(0.5, 0.5, "no map", ha="center", va="center", fontsize=9)
    with atomic_write(out) as part:
        figure.savefig(part, dpi=110, format="jpg", pil_kwargs={"quality": 88})
    pyplot.close(figure)


def verdict(title: str, row: dict[str, Any]) -> str:
    """Title above a map: the program and the share of the ground within 1 m of its true position."""
    if "error" in row:
        return f"{title}\nfailed"
    if row["right_share"] is None:
        return f"{title}\nno place; shape {100 * (row['shape_share'] or 0.0):.0f} % within 1 m"
    return f"{title}\n{100 * row['right_share']:.0f} % within 1 m"


@dataclass(frozen=True, slots=True)
class Measured:
    """Resources that a command used.

    Attributes:
        code: exit code, None if it was stopped at the limit.
        wall_s: wall time, seconds. cpu_s: CPU seconds of all its processes.
        peak_rss_mb: largest sum of their resident sizes, megabytes; pages that they share count for each.
    """

    code: int | None
    wall_s: float
    cpu_s: float
    peak_rss_mb: float


def run_measured(
    command: Sequence[str], log: Path, limit_s: float, env: Mapping[str, str] | None = None, out: Path | None = None
) -> Measured:
    """Run a command to its end or to its limit.

    Args:
        command: program and arguments.
        log: where its stderr goes (and its stdout, without `out`).
        limit_s: CPU seconds that all its processes may use; it is also stopped after twenty times as much wall time.
            CPU time, since other work on the machine does not change it.
        env: variables in addition to those of this process.
        out: where its stdout goes.

    Raises:
        InputError: where there is no /proc.
    """
    if not (_PROC / "self" / "stat").exists():
        raise InputError("other programs can only be measured on Linux; run this benchmark there")
    start, used, memory = time.monotonic(), 0.0, 0.0
    with contextlib.ExitStack() as stack:
        errors = stack.enter_context(log.open("wb"))
        output = stack.enter_context(out.open("wb")) if out else errors
        process = subprocess.Popen(
            command, stdout=output, stderr=errors, env={**os.environ, **(env or {})}, start_new_session=True
        )
        stopped, ended = False, 0
        try:
            while not ended:
                cpu_s, rss_mb = session_usage(process.pid)
                used, memory = max(used, cpu_s), max(memory, rss_mb)
                if used > limit_s or time.monotonic() - start > _WALL_FACTOR * limit_s:
                    stopped = True
                    os.killpg(process.pid, signal.SIGKILL)
                ended, status, usage = os.wait4(process.pid, 0 if stopped else os.WNOHANG)
                if not ended:
                    time.sleep(_MEASURED_EVERY_S)
            process.returncode = os.waitstatus_to_exitcode(status)
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # remaining child processes, or Ctrl-C
                os.killpg(process.pid, signal.SIGKILL)
    used = max(used, usage.ru_utime + usage.ru_stime)
    if not memory:  # it ended before the first look; the kernel's figure is an upper bound, since it
        memory = usage.ru_maxrss / 1024.0  # counts what the process that starts a program held at that time, too
    return Measured(None if stopped else process.returncode, time.monotonic() - start, used, memory)


def session_usage(session: int) -> tuple[float, float]:
    """CPU seconds and resident megabytes of a session's living processes, with the CPU time of their ended children."""
    ticks, page = os.sysconf("SC_CLK_TCK"), os.sysconf("SC_PAGE_SIZE")
    cpu, pages = 0, 0
    for entry in _PROC.iterdir():
        if not entry.name.isdigit():
            continue
        try:
            # the process name may contain spaces and brackets; the fields follow its last closing bracket
            fields = (entry / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session:
            cpu += sum(map(int, fields[11:15]))
            pages += int(fields[21])
    return cpu / ticks, pages * page / 1e6
