"""Pictures that arrive after their vehicle was refined: resected by its refined ones, which stay as they are.

A picture starts from what the refinement changed in its neighbours. Its corners are followed into their pictures, whose
ground points resect it. Measured on simulated flights over debris, water and haze (640x480 from 150 m): by the start
alone 0.2 to 2.6 m off; by resection as accurate as its neighbours among them, 0.1 to 0.3 m worse beside or beyond them;
0.07 s a picture.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array, Gray
from orthoswarm.model.camera import Camera, Lens
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import STATED_SIGMA_FACTOR, PlacedFrame, Solution, Terrain
from orthoswarm.mosaic.recorded_pose import recorded_cameras
from orthoswarm.refine.flight.unsolved_pictures import place_by_neighbours

_NEIGHBOURS: Final = 4  # refined pictures with which a late one is compared, nearest first (for its time)
_WORK_WIDTH_PX: Final = 640  # columns in which pictures are compared (for its time)
_CORNERS: Final = 300  # most corners of a late picture that are followed into each neighbour (for its time)
_CORNER_QUALITY: Final = 0.005  # least corner measure as a share of the best one
_CORNER_DISTANCE_PX: Final = 8.0  # least distance of corners (spread matters more than number)
_BORDER_PX: Final = 15  # side of the square by which the overlap is eroded before corners are chosen
_FLOW_WINDOW_PX: Final = 21  # side of the window of the Lucas-Kanade flow (OpenCV's default)
_FLOW_LEVELS: Final = 4  # levels of its pyramid: about 100 pixels of error of the start
_FLOW_BACK_PX: Final = 0.7  # a corner that does not come back this near when it is followed both ways is dropped
_FEWEST: Final = 25  # fewest points that must agree with the resection ...
_LEAST_SHARE: Final = 0.4  # ... and the least share of those found
_AGREES_PX: Final = 1.5  # points this near to where the resection puts them agree
_POSITION_SIGMA_M: Final = 5.0  # sigma of the start's position, an axis
_ATTITUDE_SIGMA_RAD: Final = 0.05  # the same of its attitude: 3 degrees
_CORNER_HEIGHT_M: Final = 0.5  # height of corners above the terrain, all alike (measured: 0.1 to 0.5)
_LEAST_NOISE_PX: Final = 0.1  # least noise of a followed corner, pixels, in the sigma that is stated
_SCALES_PX: Final = (20.0, 8.0, 3.0, 1.5, 1.0, 1.0)  # robust scales of the resection, pixels, one after the other
_ROUNDS: Final = 3  # Gauss-Newton steps at each scale, and steps onto the terrain


def register_late_pictures(
    frames: Sequence[Frame], refined: Solution, epsg: int, read: Callable[[Frame], Gray]
) -> tuple[list[PlacedFrame], dict[str, str]]:
    """Place pictures of a vehicle that was refined without them; nothing of what is refined changes.

    Returns:
        The placed frames in order of time, and image -> reason for the others. Those that too few points resect are
        `weak`, placed by the neighbours' corrections alone. The sigma of the others combines that of the neighbours,
        that of the resection, and the effect of corners above the terrain on a picture that has its neighbours on one
        side.
    """
    late = {frame.image for frame in frames}
    everyone = sorted([*frames, *(p.frame for p in refined.placed)], key=lambda f: (f.time_s or 0.0, f.image))
    recorded = recorded_cameras(everyone, LocalGrid(epsg))
    guesses = place_by_neighbours(
        [p for p in recorded.placed if p.frame.image in late],
        [p for p in recorded.placed if p.frame.image not in late],
        refined.placed,
    )
    terrain = refined.terrain or Terrain.flat(refined.ground_z_m)
    pictures: dict[str, Gray] = {}

    def small(placed: PlacedFrame) -> Gray:
        if placed.frame.image not in pictures:
            lens, gray = placed.camera.lens, read(placed.frame)
            scale = min(1.0, _WORK_WIDTH_PX / lens.width)
            size = max(1, round(lens.width * scale)), max(1, round(lens.height * scale))
            pictures[placed.frame.image] = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        return pictures[placed.frame.image]

    holds = [p for p in refined.placed if not p.weak]
    placed: list[PlacedFrame] = []
    dropped = {r.image: r.reason for r in recorded.rejected if r.image in late}
    for guess in guesses:
        try:
            picture = small(guess)
        except OrthoSwarmError as error:
            dropped[guess.frame.image] = str(error)
            continue
        away = [float(np.hypot(*(p.camera.nadir - guess.camera.nadir))) for p in holds]
        near = [holds[i] for i in np.argsort(away, kind="stable")[:_NEIGHBOURS]]
        seen = [ground_observations(guess, picture, other, small(other), terrain) for other in near]
        placed.append(_fitted(guess, seen, near))
    return placed, dropped


def ground_observations(
    one: PlacedFrame, gray: Gray, other: PlacedFrame, known: Gray, terrain: Terrain
) -> tuple[Array, Array]:
    """Ground points of a picture near its place, by its corners followed into a refined one; both at working size.

    Returns:
        Pixels (M, 2) of the first picture at full size, and the ground points (M, 3) that the other one gives them.
    """
    z = float(terrain.height(one.camera.nadir))
    mine, its = _reduced(one.camera.lens, gray), _reduced(other.camera.lens, known)
    east, north = one.camera.nadir  # about it grid coordinates lose no digits
    shift = np.array([[1.0, 0.0, -east], [0.0, 1.0, -north], [0.0, 0.0, 1.0]])
    here = shift @ replace(one.camera, lens=mine).homography(z)
    there = shift @ replace(other.camera, lens=its).homography(z)
    move = np.linalg.inv(there) @ here  # my pixels -> its pixels
    rows, cols = gray.shape
    warp = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    turned = cv2.warpPerspective(known, move, (cols, rows), flags=warp)
    inside = cv2.warpPerspective(np.full_like(known, 255), move, (cols, rows), flags=warp & ~3)
    inner = cv2.erode(inside, np.ones((_BORDER_PX, _BORDER_PX), np.uint8))
    corners = cv2.goodFeaturesToTrack(gray, _CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=inner)
    nothing = np.empty((0, 2)), np.empty((0, 3))
    if corners is None:
        return nothing
    window, levels = (_FLOW_WINDOW_PX, _FLOW_WINDOW_PX), _FLOW_LEVELS
    moved, ok, _ = cv2.calcOpticalFlowPyrLK(gray, turned, corners, corners.copy(), winSize=window, maxLevel=levels)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(turned, gray, moved, corners.copy(), winSize=window, maxLevel=levels)
    good = (ok.ravel() > 0) & (ok_back.ravel() > 0) & (np.hypot(*(back - corners)[:, 0].T) < _FLOW_BACK_PX)
    if not good.any():
        return nothing
    found = cv2.perspectiveTransform(moved[good].astype(np.float64), move)[:, 0]
    ground = on_terrain(replace(other.camera, lens=its), found, terrain)
    sure = np.isfinite(ground).all(1)
    scale = one.camera.lens.width / cols
    return ((corners[good][:, 0].astype(np.float64) + 0.5) * scale - 0.5)[sure], ground[sure]


def _reduced(lens: Lens, gray: Gray) -> Lens:
    """The lens of a picture that was made smaller."""
    rows, cols = gray.shape
    scale = cols / lens.width
    return replace(
        lens, width=cols, height=rows, focal_px=lens.focal_px * scale, cx=lens.cx * scale, cy=lens.cy * scale
    )


def on_terrain(camera: Camera, uv: Array, terrain: Terrain) -> Array:
    """Ground points (M, 3) of pixels (M, 2); NaN above the horizon."""
    z = np.full(len(uv), float(terrain.height(camera.nadir)))
    for _ in range(_ROUNDS):
        xy = camera.to_ground(uv, z)
        z = np.where(np.isfinite(xy).all(1), terrain.height(np.nan_to_num(xy)), z)
    return np.column_stack([xy, z])


def _fitted(guess: PlacedFrame, seen: Sequence[tuple[Array, Array]], near: Sequence[PlacedFrame]) -> PlacedFrame:
    """The frame with its camera resected by the neighbours' ground points; the start where too few of them agree."""
    if sum(len(uv) for uv, _ in seen) < _FEWEST:
        return guess
    uv, ground = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    camera = resected(guess.camera, uv, ground)
    scale = max(1.0, guess.camera.lens.width / _WORK_WIDTH_PX)
    off = np.hypot(*(camera.project(ground) - uv).T) / scale
    agree = off < _AGREES_PX
    if agree.sum() < max(_FEWEST, _LEAST_SHARE * len(uv)):
        return guess
    source = np.repeat(np.arange(len(near)), [len(uv) for uv, _ in seen])[agree]
    away = np.array([p.camera.nadir for p in near])[source].mean(0) - camera.nadir
    neighbour_sigma_m = float(np.median([p.sigma_m for p in near]))
    leaning = _CORNER_HEIGHT_M * float(np.hypot(*away)) / float(camera.position[2] - ground[agree, 2].mean())
    own = STATED_SIGMA_FACTOR * float(np.sqrt(len(near)))
    own *= centre_sigma(camera, uv[agree], ground[agree], scale)
    return PlacedFrame(guess.frame, camera, near[0].stage, float(np.linalg.norm([neighbour_sigma_m, leaning, own])))


def centre_sigma(camera: Camera, uv: Array, ground: Array, scale: float) -> float:
    """Sigma of an axis of where a resected picture's centre lies on the ground, by the scatter of its points, metres.

    scale: pixels of the picture in one of those in which it was compared.
    """
    off = (camera.project(ground) - uv) / scale
    noise = max(float(np.sqrt((off**2).mean())), _LEAST_NOISE_PX)
    moved = [_moved(camera, step) for step in _STEPS]
    size = _STEPS.sum(1)
    jacobian = np.stack([(c.project(ground) - uv) / scale - off for c in moved], -1).reshape(-1, 6) / size
    covariance = np.linalg.inv(jacobian.T @ jacobian / noise**2 + _PRIOR)
    middle, z = np.array([camera.lens.principal_point]), float(ground[:, 2].mean())
    centre = np.stack([(c.to_ground(middle, z) - camera.to_ground(middle, z))[0] for c in moved], -1) / size
    return float(np.sqrt(np.trace(centre @ covariance @ centre.T) / 2))


def resected(camera: Camera, uv: Array, ground: Array) -> Camera:
    """A camera's pose by ground points (M, 3) at pixels (M, 2): robust Gauss-Newton, the camera as a loose prior."""
    scale = max(1.0, camera.lens.width / _WORK_WIDTH_PX)
    total, now = np.zeros(6), camera
    for c in _SCALES_PX:
        for _ in range(_ROUNDS):
            off = (now.project(ground) - uv) / scale
            off = np.where(np.isfinite(off), off, 1e3)
            weight = robust_weights((off**2).sum(1), c * c)
            moved = [(_moved(camera, total + step).project(ground) - uv) / scale - off for step in _STEPS]
            jacobian = np.nan_to_num(np.stack(moved, -1) / _STEPS.sum(1))
            normal = np.einsum("mki,m,mkj->ij", jacobian, weight, jacobian) + _PRIOR
            right = np.einsum("mki,m,mk->i", jacobian, weight, off) + _PRIOR @ total
            total = total - np.linalg.solve(normal, right)
            now = _moved(camera, total)
    return now


_STEPS = np.diag([1e-3] * 3 + [1e-5] * 3)
_PRIOR = np.diag(1.0 / np.array([_POSITION_SIGMA_M] * 3 + [_ATTITUDE_SIGMA_RAD] * 3) ** 2)
"""Weights (6, 6) of the start's position and attitude: loose, for what points do not determine."""


def _moved(camera: Camera, change: Array) -> Camera:
    """A camera moved by metres and turned by a rotation vector in the ground's axes."""
    turn, _ = cv2.Rodrigues(change[3:])
    return Camera(camera.position + change[:3], turn @ camera.rotation, camera.lens)
