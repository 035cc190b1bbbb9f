"""An orthoimage against a reference: both on one grid, read in strips, so that memory stays small."""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.enums import Resampling
from rasterio.errors import RasterioIOError
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT
from rasterio.warp import transform_bounds
from rasterio.windows import Window

from orthoswarm.evaluation.displacement import (
    Accuracy,
    Displacements,
    FieldSettings,
    Mask,
    accuracy,
    completeness,
    displacement_field,
)
from orthoswarm.model.arrays import Floats
from orthoswarm.model.camera import Camera
from orthoswarm.model.errors import InputError


def find_mask(reference: Path, mask: str | None) -> Path | None:
    """The mask to use: the user's; without one, a twin's mask of level ground in the folder of its reference.

    Roofs and crowns lean in every orthoimage that is rectified on the ground, so they say nothing about its position.
    """
    if mask is not None:
        return None if mask == "none" else Path(mask)
    twin_mask = reference.with_name("ground_mask.tif")
    return twin_mask if twin_mask.exists() else None


def evaluate_ortho(
    ortho: Path,
    reference: Path,
    mask: Path | None = None,
    settings: FieldSettings | None = None,
    gsd_m: float | None = None,
) -> Accuracy:
    """Measure an orthoimage file against a reference file; memory stays small whatever their size.

    Args:
        ortho: RGB(A) or grey GeoTIFF. reference: the same, any CRS.
        mask: raster that is not 0 where blocks may be compared. settings: how to measure; its gsd_m is replaced.
        gsd_m: pixel of the comparison, None for 0.3 m or the coarser of both if that is more.

    Raises:
        InputError: if a file cannot be read or the two do not overlap.
    """
    field, covered, ground, s = _field(ortho, reference, mask, settings, gsd_m)
    return accuracy(field, completeness(covered, ground), float(max(1, round(s.step_m / s.gsd_m))))


def displacements(ortho: Path, reference: Path, mask: Path | None, settings: FieldSettings) -> Displacements:
    """The field of displacements of an orthoimage file against a reference file; see evaluate_ortho."""
    return _field(ortho, reference, mask, settings, None)[0]


def _field(
    ortho: Path, reference: Path, mask: Path | None, settings: FieldSettings | None, gsd_m: float | None
) -> tuple[Displacements, Mask, Mask, FieldSettings]:
    """The displacements, where both pictures are at 1.2 m, and the settings with the pixel that was used."""
    parts, own_ortho, own_ground = [], [], []
    with _Pair(ortho, reference, mask, gsd_m) as pair:
        s = dataclasses.replace(settings or FieldSettings(), gsd_m=pair.gsd_m)
        thin = max(1, round(1.2 / s.gsd_m))
        try:
            for first_row, compared, strip_ortho, strip_ground in pair.strips(s):
                parts.append(displacement_field(*compared, settings=s, offset=(first_row, 0)))
                own_ortho.append(strip_ortho[::thin, ::thin])
                own_ground.append(strip_ground[::thin, ::thin])
        except RasterioIOError:
            raise InputError(f"{ortho} or {reference} is damaged or cut short; copy or make it again") from None
    covered, ground = np.concatenate(own_ortho), np.concatenate(own_ground)
    if not (covered & ground).any():
        raise InputError(f"{ortho.name} and {reference.name} do not overlap; check that both show the same place")
    return Displacements.joined(parts), covered, ground, s


class _Pair:
    """Orthoimage, reference and mask on one grid, read in strips of blocks."""

    def __init__(self, ortho: Path, reference: Path, mask: Path | None, gsd_m: float | None) -> None:
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

    def strips(self, s: FieldSettings) -> Iterator[tuple[int, tuple[Floats, Mask, Floats, Mask], Mask, Mask]]:
        """Strips of eight rows of blocks, from north to south: first row, what is compared, and validity.

        Compared are orthoimage and reference, each with its validity; the orthoimage is larger by the search radius on
        every side. The last two are the validity of both in the rows that belong to this strip alone.
        """
        reach = max(1, round(s.search_m / s.gsd_m))
        side, step = round(s.block_m / s.gsd_m), max(1, round(s.step_m / s.gsd_m))
        rows = 8 * step
        for start in range(0, self.shape[0], rows):
            stop = min(self.shape[0], start + rows - step + side)
            ortho, ortho_valid = self._read(0, start, stop, reach)
            reference, ground = self._read(1, start, stop)
            comparable = ground
            if self._masked:
                comparable = ground & (self._views[2].read(1, window=Window(0, start, self.shape[1], stop - start)) > 0)
            own = min(rows, stop - start)
            inner = ortho_valid[reach : reach + own, reach : reach + self.shape[1]]
            yield start, (ortho, ortho_valid, reference, comparable), inner, ground[:own]

    def _read(self, which: int, start: int, stop: int, spare: int = 0) -> tuple[Floats, Mask]:
        """Grey values and validity of some rows, with `spare` more pixels on every side, invalid beyond the grid."""
        view = self._views[which]
        low, high = max(0, start - spare), min(self.shape[0], stop + spare)
        window = Window(0, low, self.shape[1], high - low)
        pad = [(low - (start - spare), stop + spare - high), (spare, spare)]
        bands = [1, 2, 3] if view.count >= 3 else [1]
        data = view.read(bands, window=window).astype(np.float32)
        gray = data[0] if len(bands) == 1 else 0.299 * data[0] + 0.587 * data[1] + 0.114 * data[2]
        return np.pad(gray, pad), np.pad(view.dataset_mask(window=window) > 0, pad)


def _floor(value: float, step: float) -> float:
    """Round down to a multiple of a step."""
    return math.floor(value / step + 1e-9) * step


def seen_share(ortho: Path, cameras: list[Camera]) -> float:
    """Share of the ground that any true camera sees (on level ground) that an orthoimage covers."""
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
