"""Shared parts of all benchmarks: data sets, cached results, a `mosaic` run as a process, the machine."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from orthoswarm.export.atomic_file import write_file
from orthoswarm.model.errors import InputError, OrthoSwarmError


def check_set(folder: Path, *, truth: bool = False) -> None:
    """Check that a folder is a data set of `twin make`.

    Raises:
        InputError: if its photos, its map or (where asked for) its truth is missing.
    """
    if not (folder / "photos").is_dir() or not (folder / "basemap.tif").exists():
        raise InputError(f"{folder} has no photos and basemap.tif; make a set with `orthoswarm twin make`")
    if truth and not (folder / "truth" / "reference.tif").exists():
        raise InputError(f"{folder} has no truth/reference.tif; make the set with `orthoswarm twin make`")


def described(folder: Path) -> dict[str, Any]:
    """Name, disaster, noise, seed and special parameters of a set, from its manifest; None where unknown."""
    manifest = folder / "truth" / "manifest.json"
    known = json.loads(manifest.read_text(encoding="utf-8")) if manifest.exists() else {}
    special = []
    if any(known.get("lens_k") or ()):
        special.append(f"lens {', '.join(f'{k:g}' for k in known['lens_k'])}")
    if known.get("relief_m"):
        special.append(f"relief +-{known['relief_m']:g} m")
    if known.get("ground"):
        special.append("real ground")
    if known.get("every", 1) > 1:
        special.append(f"1 of {known['every']} photos")
    keys = {"disaster": "disaster", "noise": "noise_name", "seed": "seed"}
    return {"set": folder.absolute().name} | {k: known.get(name) for k, name in keys.items()} | {"special": special}


def label(row: dict[str, Any]) -> str:
    """A set's label in tables: disaster, noise, special parameters, seed; else its folder's name."""
    if row.get("disaster") is None or row.get("seed") is None:
        return str(row["set"])
    disaster = {"none": "clear", "all": "all disasters"}.get(row["disaster"], row["disaster"])
    return ", ".join([disaster, row["noise"], *row.get("special", ()), f"seed {row['seed']}"])


def write_result(path: Path, value: Any) -> None:
    """Write a result as JSON; the file is complete or absent."""
    write_file(path, json.dumps(value, indent=1))


def read_result(path: Path) -> Any:
    """A result of an earlier run, None if there is none that can be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def pictures(folder: Path) -> list[Path]:
    """The photos of a folder and its sub-folders, sorted."""
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".jpg", ".jpeg") and p.is_file())


def link_photos(photos: Sequence[Path], root: Path, target: Path, *, flat: bool = False) -> None:
    """Put photos into an emptied folder, as hard links where the file system allows it, else as copies.

    Args:
        photos: files below root. root: their common folder.
        target: the folder, emptied first.
        flat: put all into one folder, the sub-folder becoming part of the name.
    """
    shutil.rmtree(target, ignore_errors=True)
    for photo in photos:
        parts = photo.relative_to(root).parts
        there = target / ("_".join(parts) if flat else Path(*parts))
        there.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(photo, there)
        except OSError:  # another file system
            shutil.copyfile(photo, there)


def mosaic_command(photos: Path, basemap: Path, out: Path, how: Sequence[str], workers: int | None) -> list[str]:
    """The command line of a `mosaic` run with this installation."""
    program = [sys.executable, "-m", "gcs_plugin.cli", "mosaic"]
    options = ["--json", *how, *(["--workers", str(workers)] if workers else [])]
    return [*program, str(photos), "--basemap", str(basemap), "--out", str(out), *options]


def mosaic(photos: Path, basemap: Path, out: Path, how: Sequence[str], workers: int | None) -> dict[str, Any]:
    """Run `mosaic` as a separate process and return its report.

    Raises:
        OrthoSwarmError: if it failed, with its message.
    """
    shutil.rmtree(out, ignore_errors=True)
    command = mosaic_command(photos, basemap, out, how, workers)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OrthoSwarmError(error_line(done.stderr))
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def error_line(stderr: str) -> str:
    """The line of stderr that says why a program failed: this program's own message, else the last line."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    own = [line for line in lines if line.startswith("orthoswarm:")]
    return ((own or lines) or ["it ended without a message"])[-1].removeprefix("orthoswarm: ")


def cost(report: dict[str, Any]) -> dict[str, Any]:
    """CPU time, wall time and memory of a run from its report; stages with the same name before the colon are added."""
    stages: dict[str, float] = {}
    for stage in report["stages"]:
        name = stage["name"].split(":")[0]
        stages[name] = stages.get(name, 0.0) + stage["cpu_s"]
    keys = ("wall_s", "cpu_s", "peak_rss_mb")
    return {k: report[k] for k in keys} | {"frames": report["frames"]["used"], "stages": stages}


def text(value: float | None, digits: int) -> str:
    """A number for a table, a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def share(value: float | None, digits: int = 1) -> str:
    """A share as percent, a dash for None."""
    return "-" if value is None else f"{100 * value:.{digits}f} %"


def numbers(value: str, flag: str) -> list[int]:
    """A comma-separated list of positive whole numbers; raises InputError: if it is not such a list."""
    try:
        found = [int(part) for part in value.split(",") if part.strip()]
    except ValueError:
        found = []
    if not found or min(found) < 1:
        raise InputError(f"{flag} {value} is not a list of numbers; give for example 1,2,4")
    return found


def machine() -> str:
    """Description of the machine: usable cores, processor, GPU."""
    import platform

    from orthoswarm.compute.workers import cores

    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    model = [*names, platform.processor() or platform.machine()][0]
    gpu = "an NVIDIA GPU" if shutil.which("nvidia-smi") else "no GPU"
    return f"{cores()} cores of {model}, {gpu}"
