"""One pair of pictures: epipolar rectification, semi-global matching, and the ground points of its matches.

The rectified cameras look along the mean of both lines of sight, at right angles to the base, with rows along it
(Fusiello et al. 2000); matching is Hirschmüller's (2008) as OpenCV has it.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from orthoswarm.config.mapping import StereoConfig
from orthoswarm.model.arrays import Array, Flags, Floats, Gray
from orthoswarm.model.camera import Camera
from orthoswarm.model.placement import Terrain

_FRACTION = 16.0  # disparities of OpenCV are whole numbers of this part of a pixel

_BLOCK_PX: Final = 3
"""Side of the blocks of semi-global matching. With 3, 5, 7 heights of roofs were within (68 %) 1.25, 1.42 and 1.76 m of
their median error, ground as good with each."""
_UNIQUE_PERCENT: Final = 10  # least cost of the second best match over the best: OpenCV recommends 5-15
_SPECKLE_PX: Final = 60  # smaller regions of alike disparity are false matches: OpenCV recommends 50-200
_DISPARITY_SIGMA_PX: Final = 0.25  # 68 % of single pairs' heights are within 0.24 of it at a base of 0.25, 0.22 at 0.7
_TALLEST_HEIGHTS: Final = 0.45  # the highest searched, over the camera's height above ground, where `tallest_m` is more
_SMOOTHNESS: Final = (8.0, 32.0)
"""Penalty of a disparity that differs by one, and by more, times the block's area: OpenCV's recommendation."""
_WIDE_PX: Final = 128
"""Pairs with a search range of more disparities are matched at half size first, to find those that occur: for fewer the
time saved is less than what it takes."""
_WIDE_REGION_PX: Final = 400  # where more disparities are matched: least region at half size (40 x 40) ...
_WIDE_MARGIN: Final = 0.15  # ... with this share of their range to either side, and 2 pixels at half size


@dataclass(frozen=True, slots=True)
class PairView:
    """A picture with its camera.

    camera: of the full picture. gray: uint8 (rows, columns), the picture reduced by `factor` along each side.
    """

    camera: Camera
    gray: Gray
    factor: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rectified:
    """The common frame of a pair.

    Attributes:
        axes: float64 (3, 3), its x (along the base), y and z (depth) axes in east, north, up, as columns.
        base_m: distance of the cameras. focal_px: of both rectified pictures.
        left, top: place of pixel (0, 0) relative to the principal point, pixels.
        width, height: of the rectified pictures. shift: smallest disparity; count: number of disparities.
    """

    axes: Array
    base_m: float
    focal_px: float
    left: int
    top: int
    width: int
    height: int
    shift: int
    count: int


@dataclass(frozen=True, slots=True)
class PairPoints:
    """Points of a pair: float64 (N, 3) east, north, up, and one sigma of each height, float64 (N,)."""

    points: Array
    sigma_m: Array


def match_pair(first: PairView, second: PairView, terrain: Terrain, config: StereoConfig) -> PairPoints:
    """Ground points of two overlapping pictures, with the sigmas of their heights.

    Args:
        first, second: the pictures. terrain: ground around which heights are searched. config: how far.

    Returns:
        The points of all consistent matches, none if the pictures overlap too little.
    """
    frame = _common_frame(first, second, terrain, config)
    if frame is None:
        return PairPoints(np.zeros((0, 3)), np.zeros(0))
    left, valid_left = _resampled(first, frame, 0)
    right, valid_right = _resampled(second, frame, frame.shift)
    disparity = _disparities(left, right, valid_left, frame.count)
    rows, columns = np.nonzero(valid_left & (disparity >= 0.0))
    found = disparity[rows, columns]
    other = np.rint(columns - found).astype(np.intp)
    within = other >= 0
    within[within] = valid_right[rows[within], other[within]]
    rows, columns, total = rows[within], columns[within], found[within] + frame.shift
    positive = total > 0.0
    rows, columns, total = rows[positive], columns[positive], total[positive]
    depth = frame.focal_px * frame.base_m / total
    rays = np.stack([columns + frame.left, rows + frame.top, np.full(len(rows), frame.focal_px)], -1) / frame.focal_px
    points = first.camera.position + (rays * depth[:, None]) @ frame.axes.T
    along = abs(float(frame.axes[2, 2])) * _DISPARITY_SIGMA_PX
    return PairPoints(points, along * depth / total)


def _common_frame(left: PairView, right: PairView, terrain: Terrain, config: StereoConfig) -> _Rectified | None:
    """The rectified frame: the first picture's extent, on the rows that both have, with the heights' disparities."""
    first, second = left.camera, right.camera
    base = second.position - first.position
    base_m = float(np.linalg.norm(base))
    x = base / base_m
    z = first.rotation[:, 2] + second.rotation[:, 2]
    z = z - x * (z @ x)
    z = z / np.linalg.norm(z)
    axes = np.stack([x, np.cross(z, x), z], 1)
    focal = min(view.camera.lens.focal_px / view.factor for view in (left, right))
    one, two = _outline(first, axes), _outline(second, axes)
    if one is None or two is None:
        return None
    low, high = one.min(0) * focal, one.max(0) * focal
    top, bottom = max(low[1], two[:, 1].min() * focal), min(high[1], two[:, 1].max() * focal)
    width, height = int(np.ceil(high[0] - low[0])) + 1, int(np.ceil(bottom - top)) + 1
    ground = _levels(first, terrain)
    above = min(config.tallest_m, _TALLEST_HEIGHTS * (float(first.position[2]) - ground[1]))
    depths = [_depths(first, axes, ground[0] - config.depth_m), _depths(first, axes, ground[1] + above)]
    if height < 4 * _BLOCK_PX or not min(d.min() for d in depths) > 0.0:
        return None
    disparity = focal * base_m / np.concatenate(depths)
    shift = int(np.floor(disparity.min()))
    count = _whole_steps(float(disparity.max()) - shift + 1.0)
    return _Rectified(
        axes=axes, base_m=base_m, focal_px=focal, left=int(np.floor(low[0])), top=int(np.floor(top)), width=width,
        height=height, shift=shift, count=count,
    )  # fmt: skip


def _rim(camera: Camera) -> Array:
    """Pixels (8, 2) on the picture's border."""
    w, h = camera.lens.width - 1.0, camera.lens.height - 1.0
    return np.array([[0, 0], [w / 2, 0], [w, 0], [w, h / 2], [w, h], [w / 2, h], [0, h], [0, h / 2]])


def _outline(camera: Camera, axes: Array) -> Array | None:
    """The border in normalised coordinates (8, 2) of the rectified frame; None if a point lies behind it."""
    lens = camera.lens
    xy = lens.undistort((_rim(camera) - np.array(lens.principal_point)) / lens.focal_px)
    ray = np.concatenate([xy, np.ones((len(xy), 1))], 1) @ (camera.rotation.T @ axes)
    return ray[:, :2] / ray[:, 2:] if (ray[:, 2] > 0.2).all() else None


def _levels(camera: Camera, terrain: Terrain) -> tuple[float, float]:
    """The lowest and the highest ground below a picture."""
    w, h = camera.lens.width - 1.0, camera.lens.height - 1.0
    columns, rows = np.meshgrid(np.linspace(0, w, 5), np.linspace(0, h, 5))
    ground = camera.to_ground(np.stack([columns.ravel(), rows.ravel()], -1), float(terrain.height(camera.nadir)))
    z = terrain.height(ground[np.isfinite(ground).all(1)])
    return (float(z.min()), float(z.max())) if len(z) else (0.0, 0.0)


def _depths(camera: Camera, axes: Array, level_m: float) -> Array:
    """Depths along the rectified z axis of the border's points on a level."""
    ground = camera.to_ground(_rim(camera), level_m)
    points = np.column_stack([ground, np.full(len(ground), level_m)])
    return np.asarray(np.nan_to_num((points - camera.position) @ axes[:, 2], nan=-1.0))


def _resampled(view: PairView, frame: _Rectified, shift: int) -> tuple[Gray, Flags]:
    """A picture in the rectified frame, moved right by `shift` pixels, and where it has content."""
    lens, factor = view.camera.lens, view.factor
    u, v = ((p + 0.5) / factor - 0.5 for p in lens.principal_point)
    focal = lens.focal_px / factor
    inner = np.array([[focal, 0.0, u], [0.0, focal, v], [0.0, 0.0, 1.0]])
    rectified = np.array(
        [[frame.focal_px, 0.0, shift - frame.left], [0.0, frame.focal_px, -frame.top], [0.0, 0.0, 1.0]]
    )
    terms = np.array([lens.k1, lens.k2, 0.0, 0.0, lens.k3])
    turn = frame.axes.T @ view.camera.rotation
    column, row = cv2.initUndistortRectifyMap(inner, terms, turn, rectified, (frame.width, frame.height), cv2.CV_32FC1)
    height, width = view.gray.shape
    seen = (column >= 0) & (row >= 0) & (column <= width - 1) & (row <= height - 1)
    picture = cv2.remap(view.gray, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(picture, np.uint8), seen


def _disparities(left: Gray, right: Gray, valid: Flags, count: int) -> Floats:
    """Disparity of each pixel of the left picture, float32 in 0 to count - 1, negative where no match is found.

    left, right: rectified. valid: where the left one has content. count: disparities that may occur.
    """
    least = 0
    if count > _WIDE_PX:
        least, count = _occurring(left, right, valid, count)
    return _matched(left, right, least, count)


def _occurring(left: Gray, right: Gray, valid: Flags, count: int) -> tuple[int, int]:
    """The range of disparities that occurs, by matching at half size, which takes an eighth of the time.

    Only large regions of alike disparity count: false matches are small and have any disparity. Returns the least
    disparity and the number of them.
    """
    one, two = (np.asarray(cv2.resize(p, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)) for p in (left, right))
    half = _whole_steps(count / 2)
    found = _matched(one, two, 0, half)
    content = cv2.resize(valid.astype(np.uint8), one.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    whole = np.where(content & (found >= 1.0) & (found < half - 2.0), found * _FRACTION, -_FRACTION).astype(np.int16)
    cv2.filterSpeckles(whole, -_FRACTION, _WIDE_REGION_PX, _FRACTION)
    occurring = whole[whole >= 0] / _FRACTION
    if len(occurring) == 0:
        return 0, count
    low, high = float(occurring.min()), float(occurring.max())
    margin = _WIDE_MARGIN * (high - low) + 2.0
    least = 16 * max(0, int(2.0 * (low - margin) / 16.0))
    return least, min(count - least, _whole_steps(2.0 * (high + margin) - least))


def _whole_steps(disparities: float) -> int:
    """A number of disparities that the matcher takes: a multiple of 16."""
    return 16 * max(1, int(np.ceil(disparities / 16.0)))


def _matched(left: Gray, right: Gray, least: int, count: int) -> Floats:
    """`_disparities` among `count` ones from `least` on."""
    area, last = _BLOCK_PX**2, least + count
    matcher = cv2.StereoSGBM.create(
        minDisparity=least, numDisparities=count, blockSize=_BLOCK_PX, P1=int(_SMOOTHNESS[0] * area),
        P2=int(_SMOOTHNESS[1] * area), disp12MaxDiff=1, uniquenessRatio=_UNIQUE_PERCENT,
        speckleWindowSize=_SPECKLE_PX, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    pads = (0, 0, last, 0, cv2.BORDER_REPLICATE)  # the matcher leaves out as many columns as the largest disparity
    found = matcher.compute(cv2.copyMakeBorder(left, *pads), cv2.copyMakeBorder(right, *pads))[:, last:]
    return np.where(found < least * _FRACTION, -1.0, found / _FRACTION).astype(np.float32)
