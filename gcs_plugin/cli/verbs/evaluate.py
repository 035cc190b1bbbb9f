"""`orthoswarm evaluate`: an orthoimage against a reference, placed frames against true cameras."""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from orthoswarm.evaluation.displacement import Accuracy, FieldSettings, Floats, Mask
    from orthoswarm.evaluation.pose_errors import PoseErrors
    from orthoswarm.model.camera import Camera


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "completeness is the covered share of the ground within the convex hull of what is covered: holes count, what\n"
        "is missing at the edge does not; with --truth, seen_share is that of all ground that the cameras saw.\n\n"
        "example:\n  orthoswarm evaluate out/orthoimage.tif --reference twin/truth/reference.tif \\\n"
        "      --poses out/frames.jsonl --truth twin/truth/frames.csv --json"
    )
    add = parser.add_argument
    add("ortho", type=Path, metavar="ORTHO.tif", help="the orthoimage (alpha or nodata says where it has ground)")
    add("--reference", type=Path, required=True, metavar="REF.tif", help="what it is measured against")
    add(
        "--mask",
        metavar="MASK.tif",
        help="compare only where this is not 0 (default: ground_mask.tif beside the reference; none: no mask)",
    )
    add("--poses", type=Path, metavar="FRAMES.jsonl", help="placed frames of the same product")
    add("--truth", type=Path, metavar="FRAMES.csv", help="the true cameras")
    add("--gsd", type=float, metavar="M", help="pixel at which both are compared (default 0.3, or what they have)")
    add("--search", type=float, default=8.0, metavar="M", help="largest displacement that is looked for (default 8)")
    add("--field", type=Path, metavar="FIELD.csv", help="write the field of displacements")
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    from orthoswarm.evaluation.displacement import FieldSettings
    from orthoswarm.model.errors import InputError

    if (args.poses is None) != (args.truth is None):
        raise InputError("--poses and --truth belong together; give both or none")
    mask = find_mask(args.reference, args.mask)
    result = evaluate_ortho(args.ortho, args.reference, mask, FieldSettings(search_m=args.search), args.gsd)
    figures: dict[str, Any] = dict(result.figures())
    figures["mask"] = None if mask is None else mask.name
    if args.poses is not None:
        figures["poses"] = evaluate_poses(args.poses, args.truth).figures()
        figures["seen_share"] = seen_share(args.ortho, [camera for _, _, camera in read_truth(args.truth).values()])
    if args.field is not None:
        _write_field(args.field, result)
    if args.json:
        print(json.dumps(figures))
    else:
        _print(figures)
    return 0


def find_mask(reference: Path, given: str | None) -> Path | None:
    """The mask to use: the one given; without one, a twin's mask of level ground beside its reference.

    Roofs and crowns lean in every orthoimage that is rectified on the ground, so they say nothing about its position.
    """
    if given is not None:
        return None if given == "none" else Path(given)
    beside = reference.with_name("ground_mask.tif")
    return beside if beside.exists() else None


def evaluate_ortho(
    ortho: Path,
    reference: Path,
    mask: Path | None = None,
    settings: "FieldSettings | None" = None,
    gsd_m: float | None = None,
) -> "Accuracy":
    """Measure an orthoimage file against a reference file; memory stays small whatever their size.

    Args:
        ortho: RGB(A) or grey GeoTIFF.
        reference: the same, any CRS.
        mask: raster that is not 0 where blocks may be compared.
        settings: how to measure; its gsd_m is replaced.
        gsd_m: pixel of the comparison, None for 0.3 m or the coarser of both if that is more.

    Raises:
        InputError: if a file cannot be read or the two do not overlap.
    """
    import dataclasses

    import numpy as np

    from orthoswarm.evaluation.displacement import (
        Displacements,
        FieldSettings,
        accuracy,
        completeness,
        displacement_field,
    )
    from orthoswarm.model.errors import InputError

    parts, own_ortho, own_ground = [], [], []
    with _Pair(ortho, reference, mask, gsd_m) as pair:
        s = dataclasses.replace(settings or FieldSettings(), gsd_m=pair.gsd_m)
        thin = max(1, round(1.2 / s.gsd_m))
        for strip in pair.strips(s):
            args = (strip.ortho, strip.ortho_valid, strip.reference, strip.comparable)
            parts.append(displacement_field(*args, settings=s, offset=(strip.first_row, 0)))
            own_ortho.append(strip.own_ortho[::thin, ::thin])
            own_ground.append(strip.own_ground[::thin, ::thin])
    covered, ground = np.concatenate(own_ortho), np.concatenate(own_ground)
    if not (covered & ground).any():
        raise InputError(f"{ortho.name} and {reference.name} do not overlap; check that both show the same place")
    step = max(1, round(s.step_m / s.gsd_m))
    return accuracy(Displacements.joined(parts), completeness(covered, ground, s.gsd_m * thin), float(step))


class _Strip(NamedTuple):
    """Some rows of blocks: pictures with validity, and the validity of the rows that belong to this strip alone.

    The orthoimage is larger than the reference by the search radius on every side.
    """

    first_row: int
    ortho: "Floats"
    ortho_valid: "Mask"
    reference: "Floats"
    comparable: "Mask"
    own_ortho: "Mask"
    own_ground: "Mask"


class _Pair:
    """Orthoimage, reference and mask on one grid, read in strips of blocks."""

    def __init__(self, ortho: Path, reference: Path, mask: Path | None, gsd_m: float | None) -> None:
        import rasterio
        from rasterio.enums import Resampling
        from rasterio.errors import RasterioIOError
        from rasterio.transform import from_origin
        from rasterio.vrt import WarpedVRT
        from rasterio.warp import transform_bounds

        from orthoswarm.model.errors import InputError

        files = []
        for path in (ortho, reference, mask):
            if path is None:
                continue
            try:
                files.append(rasterio.open(path))
            except RasterioIOError as error:
                raise InputError(f"{path} cannot be read as a raster ({error})") from None
            if files[-1].crs is None:
                raise InputError(f"{path} has no CRS; it cannot be compared")
        crs = files[0].crs if files[0].crs.is_projected else files[1].crs
        if not crs.is_projected:
            raise InputError("neither picture is in a projected CRS; warp one to UTM first")
        boxes = [transform_bounds(f.crs, crs, *f.bounds) for f in files[:2]]
        own = [(b[2] - b[0]) / f.width for b, f in zip(boxes, files, strict=False)]
        self.gsd_m = gsd_m or max(0.3, *(round(size, 3) for size in own))
        left, low = max(b[0] for b in boxes), max(b[1] for b in boxes)
        right, top = min(b[2] for b in boxes), min(b[3] for b in boxes)
        if right - left < 2 or top - low < 2:
            raise InputError(f"{ortho.name} and {reference.name} do not overlap; check that both show the same place")
        west, north = _floor(left, self.gsd_m), -_floor(-top, self.gsd_m)
        self.shape = (int((north - low) / self.gsd_m), int((right - west) / self.gsd_m))
        self._files = files
        self._views = []
        for file, size in zip(files, [*own, self.gsd_m], strict=False):
            mode = Resampling.average if size < 0.7 * self.gsd_m else Resampling.cubic
            if file is files[-1] and mask is not None:
                mode = Resampling.nearest
            self._views.append(
                WarpedVRT(
                    file,
                    crs=crs,
                    transform=from_origin(west, north, self.gsd_m, self.gsd_m),
                    height=self.shape[0],
                    width=self.shape[1],
                    resampling=mode,
                    add_alpha=file.nodata is None and file.count in (1, 3),
                )
            )
        self._masked = mask is not None

    def __enter__(self) -> "_Pair":
        return self

    def __exit__(self, *_: object) -> None:
        for file in [*self._views, *self._files]:
            file.close()

    def strips(self, s: "FieldSettings") -> Iterator[_Strip]:
        """Strips of eight rows of blocks, from north to south."""
        reach = max(1, round(s.search_m / s.gsd_m))
        side, step = round(s.block_m / s.gsd_m), max(1, round(s.step_m / s.gsd_m))
        rows = 8 * step
        for start in range(0, self.shape[0], rows):
            stop = min(self.shape[0], start + rows - step + side)
            ortho, ortho_valid = self._read(0, start, stop, reach)
            reference, ground = self._read(1, start, stop)
            comparable = ground & self._mask(start, stop) if self._masked else ground
            own = min(rows, stop - start)
            inner = ortho_valid[reach : reach + own, reach : reach + self.shape[1]]
            yield _Strip(start, ortho, ortho_valid, reference, comparable, inner, ground[:own])

    def _read(self, which: int, start: int, stop: int, spare: int = 0) -> "tuple[Floats, Mask]":
        """Grey values and validity of some rows, with `spare` more pixels on every side, invalid beyond the grid."""
        import numpy as np
        from rasterio.windows import Window

        view = self._views[which]
        low, high = max(0, start - spare), min(self.shape[0], stop + spare)
        window = Window(0, low, self.shape[1], high - low)
        pad = [(low - (start - spare), stop + spare - high), (spare, spare)]
        bands = [1, 2, 3] if view.count >= 3 else [1]
        data = view.read(bands, window=window).astype(np.float32)
        gray = data[0] if len(bands) == 1 else 0.299 * data[0] + 0.587 * data[1] + 0.114 * data[2]
        return np.pad(gray, pad), np.pad(view.dataset_mask(window=window) > 0, pad)

    def _mask(self, start: int, stop: int) -> "Mask":
        from rasterio.windows import Window

        mask: Mask = self._views[2].read(1, window=Window(0, start, self.shape[1], stop - start)) > 0
        return mask


def _floor(value: float, step: float) -> float:
    """Round down to a multiple of a step."""
    import math

    return math.floor(value / step + 1e-9) * step


def read_truth(path: Path) -> "dict[str, tuple[str, int, Camera]]":
    """True cameras of a twin's frames.csv: image -> (vehicle, EPSG, camera).

    Raises:
        InputError: if the file is not such a table.
    """
    import csv

    import numpy as np

    from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
    from orthoswarm.model.errors import InputError
    from orthoswarm.model.geo import LocalGrid

    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        out = {}
        for row in rows:
            grid = LocalGrid(int(row["epsg"]))
            position = np.array([float(row[k]) for k in ("easting", "northing", "height")])
            convergence = grid.convergence_rad(*grid.to_geographic(position[:2]))
            yaw, pitch, roll = (np.radians(float(row[k])) for k in ("yaw_deg", "pitch_deg", "roll_deg"))
            width, height = _size(row, path)
            focal = focal_px(np.radians(float(row["fov_deg"])), width)
            lens = Lens(width, height, focal, k1=float(row.get("k1") or 0), k2=float(row.get("k2") or 0))
            camera = Camera(position, rotation_from_angles(yaw - convergence, pitch, roll), lens)
            out[row["image"]] = (row["vehicle"], grid.epsg, camera)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is no table of true cameras ({error}); give a twin's truth/frames.csv") from None
    return out


def _size(row: dict[str, str], truth: Path) -> tuple[int, int]:
    """Columns and rows of a picture: from the table, else from the picture beside it, else 640x480."""
    if row.get("width_px") and row.get("height_px"):
        return int(row["width_px"]), int(row["height_px"])
    picture = truth.parent.parent / "photos" / row["image"]
    if picture.exists():
        from PIL import Image

        with Image.open(picture) as image:
            return image.width, image.height
    return 640, 480


def evaluate_poses(poses: Path, truth: Path) -> "PoseErrors":
    """Compare a product's frames.jsonl with true cameras.

    The plane of the homographies is `ground_z_m` of report.json beside frames.jsonl (0 without one); the true ground
    level is the median of dtm.tif beside the truth, at the cameras' nadirs (0 without one).

    Raises:
        InputError: if nothing in common can be read.
    """
    import numpy as np

    from orthoswarm.evaluation.pose_errors import Placement, pose_errors
    from orthoswarm.model.errors import InputError
    from orthoswarm.model.geo import LocalGrid

    true = read_truth(truth)
    placed, cameras = [], []
    try:
        records = [json.loads(line) for line in poses.read_text().splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise InputError(f"{poses} cannot be read as frames ({error})") from None
    for record in records:
        found = _match(record.get("image", ""), true)
        if found is None or record.get("stage") == "rejected" or not record.get("homography"):
            continue
        vehicle, epsg, camera = true[found]
        homography = np.asarray(record["homography"], float)
        if int(record["epsg"]) != epsg:
            there = LocalGrid(epsg).to_geographic(camera.position[:2])
            moved = LocalGrid(int(record["epsg"])).to_grid(there[0], there[1])
            shift = np.array(
                [[1, 0, *(camera.position[:1] - moved[:1])], [0, 1, *(camera.position[1:2] - moved[1:])], [0, 0, 1.0]]
            )
            homography = shift @ homography
        placed.append(Placement(found, vehicle, homography, record.get("fov_deg"), record.get("sigma_m")))
        cameras.append(camera)
    if not placed:
        raise InputError(f"no placed frame of {poses} stands in {truth}; do both belong to the same set?")
    report = poses.with_name("report.json")
    plane = float(json.loads(report.read_text()).get("ground_z_m") or 0.0) if report.exists() else 0.0
    return pose_errors(placed, cameras, plane, _ground_level(truth.with_name("dtm.tif"), cameras))


def seen_share(ortho: Path, cameras: "list[Camera]") -> float:
    """Share of the ground that any true camera sees (on level ground) that an orthoimage covers."""
    import cv2
    import numpy as np
    import rasterio

    with rasterio.open(ortho) as file:
        thin = max(1, round(1.2 / file.transform.a))
        shape = (file.height // thin, file.width // thin)
        covered = file.read_masks(1, out_shape=shape) > 0
        place = file.transform * file.transform.scale(file.width / shape[1], file.height / shape[0])
    # ground beyond the raster counts as not covered: look at a canvas with a rim of 400 m
    rim = round(400.0 / place.a)
    seen = np.zeros((shape[0] + 2 * rim, shape[1] + 2 * rim), np.uint8)
    for camera in cameras:
        corners = camera.corners()
        pixels = np.stack([(corners[:, 0] - place.c) / place.a, (corners[:, 1] - place.f) / place.e], -1) + rim
        if np.isfinite(pixels).all():
            cv2.fillConvexPoly(seen, np.round(pixels).astype(np.int32), 1)
    inner = seen[rim : rim + shape[0], rim : rim + shape[1]] > 0
    return float((inner & covered).sum()) / max(1.0, float(seen.sum()))


def _match(image: str, names: dict[str, Any]) -> str | None:
    """The truth's name of an image: the longest common tail of path parts."""
    parts = image.replace("\\", "/").split("/")
    for k in range(len(parts)):
        tail = "/".join(parts[k:])
        if tail in names:
            return tail
    hits = [name for name in names if name.endswith("/" + image)]
    return hits[0] if len(hits) == 1 else None


def _ground_level(dtm: Path, cameras: list[Any]) -> float:
    if not dtm.exists():
        return 0.0
    import numpy as np
    import rasterio

    with rasterio.open(dtm) as file:
        values = np.array([v[0] for v in file.sample([c.position[:2] for c in cameras])], float)
    return float(np.median(values))


def _write_field(path: Path, result: "Accuracy") -> None:
    import numpy as np

    f = result.field
    table = np.c_[f.position, f.shift_m, f.peak]
    np.savetxt(path, table, "%.4f", ",", header="column,row,east_m,north_m,peak", comments="")


def _print(figures: dict[str, Any]) -> None:
    for name, value in figures.items():
        if isinstance(value, dict):
            print(f"{name}:")
            for key, inner in value.items():
                print(f"  {key:<24} {_text(inner)}")
        else:
            print(f"{name:<26} {_text(value)}")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(_text(v) for v in value)
    return "-" if value is None else str(value)
