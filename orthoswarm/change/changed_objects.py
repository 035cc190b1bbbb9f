"""Changed ground as objects: outlines with area, probability, kind, and the photos that show them best."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np

from orthoswarm.change.change_map import ChangeMap
from orthoswarm.change.evidence import CASES
from orthoswarm.coverage.view import View

LEAST_M2: Final = 25.0  # smaller objects are not listed
NEW_OBJECT, CHANGED = "new object", "changed"
_STANDS_M: Final = 1.5  # a new object is higher
_SURE: Final = 0.6  # share of an object's cells that make it of a kind
_PHOTOS: Final = 3
_NEAREST: Final = 40  # views below which a place is looked for
_OUTLINE_CELLS: Final = 0.6  # the outline may be so far beside the cells' edges


class ChangedObject(NamedTuple):
    """Changed ground."""

    area_m2: float  # its area
    probability: float  # mean over it, 0 to 1
    kind: str  # in a word
    outline: Any  # shapely polygon in the map's grid, with holes
    place: np.ndarray  # float64 (3,), a point of it and its height
    photos: tuple[tuple[str, str], ...]  # (vehicle, image) of those that show it best, the best first


def find_objects(
    found: ChangeMap, views: Sequence[View], ground_z_m: float, threshold: float = 0.5
) -> list[ChangedObject]:
    """The objects of a change map, the largest first.

    Args:
        found: the map. views: all pictures. ground_z_m: level of the ground.
        threshold: cells count as changed from this probability on: lower for fewer misses, higher for fewer alarms.
    """
    import shapely
    from rasterio.features import shapes

    cell_m2 = found.grid.gsd_m**2
    changed = found.visible & (found.probability >= round(255 * threshold))
    wet = changed & (found.case == CASES.index("water"))
    # What stands beside the water is another thing than the water.
    labels = np.zeros(changed.shape, np.int32)
    count = 0
    for part in (wet, changed & ~wet):
        number, own, stats, _ = cv2.connectedComponentsWithStats(
            part.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S
        )
        large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] * cell_m2 >= LEAST_M2)
        large = large[large > 0]
        new = np.zeros(number, np.int32)
        new[large] = count + 1 + np.arange(len(large))
        labels[part] = new[own[part]]
        count += len(large)
    outlines: dict[int, list[Any]] = {}
    for geometry, value in shapes(labels, mask=labels > 0, connectivity=8, transform=found.grid.affine()):
        outlines.setdefault(int(value), []).append(shapely.geometry.shape(geometry))
    order = np.argsort(labels, axis=None, kind="stable")
    ends = np.searchsorted(labels.ravel()[order], np.arange(1, count + 2))
    out = []
    for label, shape in sorted(outlines.items()):
        cells = np.unravel_index(order[ends[label - 1] : ends[label]], labels.shape)
        outline = shapely.union_all(shape).simplify(_OUTLINE_CELLS * found.grid.gsd_m)
        inner = outline.representative_point()
        place = np.array([inner.x, inner.y, ground_z_m])
        out.append(
            ChangedObject(
                float(len(cells[0]) * cell_m2), float(found.probability[cells].mean()) / 255.0,
                _kind(found, cells), outline, place, best_photos(views, place),
            )
        )  # fmt: skip
    return sorted(out, key=lambda one: -one.area_m2)


def _kind(found: ChangeMap, cells: tuple[np.ndarray, ...]) -> str:
    """The kind of an object where it is sure."""
    shares = np.bincount(found.case[cells], minlength=len(CASES)) / len(cells[0])
    case = int(shares.argmax())
    if shares[case] >= _SURE:
        return CASES[case]
    return NEW_OBJECT if float(np.median(found.height[cells])) > _STANDS_M else CHANGED


def best_photos(views: Sequence[View], place: np.ndarray) -> tuple[tuple[str, str], ...]:
    """Vehicle and name of the photos that have a place (3,) nearest to their middle, the best first."""
    if not views:
        return ()
    away = np.array([view.position[:2] for view in views]) - place[:2]
    ranked = []
    for k in np.argsort((away**2).sum(1))[:_NEAREST]:
        view = views[int(k)]
        x, y, depth = view.to_camera @ (place - view.position)
        if depth <= 0.0:
            continue
        u, v = np.array([x, y]) / depth * view.lens.focal_px
        if abs(u) < 0.48 * view.lens.width and abs(v) < 0.48 * view.lens.height:
            ranked.append((float(np.hypot(u, v)) / view.lens.width, view.vehicle, view.image))
    return tuple((vehicle, image) for _, vehicle, image in sorted(ranked)[:_PHOTOS])
