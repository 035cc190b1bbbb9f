"""Georeferencing of other programs' results: camera models by recorded positions, mosaics by a homography."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array, Bytes
from orthoswarm.model.errors import OrthoSwarmError

if TYPE_CHECKING:
    from orthoswarm.model.camera import Camera


_LEAST_CAMERAS = 4  # to fit a similarity
_ROUNDS = 30  # of reweighting, with the median residual as scale
_LEAST_INLIERS = 40  # matches
_MATCHED_PX = 6_000_000


class SpaceSimilarity(NamedTuple):
    """X -> scale * rotation @ X + shift."""

    scale: float
    rotation: Array
    shift: Array

    def apply(self, points: Array) -> Array:
        """Transformed points (..., 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)


def fit_similarity(source: Array, target: Array) -> SpaceSimilarity:
    """Robust similarity from source to target points: least squares (Umeyama), reweighted by Geman-McClure.

    Args:
        source: (N, 3), any frame and scale. target: (N, 3), metres.

    Raises:
        OrthoSwarmError: for fewer than four points, or collinear ones, which leave a rotation undetermined.
    """
    if len(source) < _LEAST_CAMERAS:
        raise OrthoSwarmError(f"{len(source)} cameras are too few to place a model")
    weight = np.ones(len(source))
    for _ in range(_ROUNDS):
        found = _weighted(source, target, weight)
        residual = np.linalg.norm(found.apply(source) - target, axis=1)
        spread = max(float(np.median(residual)), 1e-6)
        weight = robust_weights((residual / (2.0 * spread)) ** 2, 1.0)
    return found


def _weighted(source: Array, target: Array, weight: Array) -> SpaceSimilarity:
    weight = weight / weight.sum()
    mean_s, mean_t = weight @ source, weight @ target
    s, t = source - mean_s, target - mean_t
    u, d, vt = np.linalg.svd((t * weight[:, None]).T @ s)
    if d[1] < 1e-6 * max(d[0], 1e-300):
        raise OrthoSwarmError("its cameras are collinear, which leaves a rotation undetermined")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (weight @ (s * s).sum(1)))
    return SpaceSimilarity(scale, rotation, mean_t - scale * rotation @ mean_s)


def placed_models(models: Sequence[dict[str, Any]], recorded: Mapping[str, Array]) -> "tuple[dict[str, Camera], float]":
    """Cameras of all models in the grid of the recorded positions, and the median ground height.

    Each model is georeferenced independently, the largest first; a picture in two models gets the larger one's camera.
    Models with fewer than four cameras, or collinear ones, are left out.

    Args:
        models: as inside/colmap.py writes them.
        recorded: image -> easting, northing, height in metres.

    Returns:
        Image -> camera; the median height of the models' 3-D points, for pasting on flat ground.

    Raises:
        OrthoSwarmError: if no model can be placed.
    """
    from orthoswarm.model.camera import Camera, Lens

    cameras: dict[str, Camera] = {}
    heights: list[Array] = []
    for model in sorted(models, key=lambda m: -len(m["cameras"])):
        own = {k: v for k, v in model["cameras"].items() if k in recorded}
        centers = np.array([v["center"] for v in own.values()]).reshape(-1, 3)
        try:
            to_grid = fit_similarity(centers, np.array([recorded[k] for k in own]).reshape(-1, 3))
        except OrthoSwarmError:
            continue
        for (name, camera), center in zip(own.items(), to_grid.apply(centers), strict=True):
            lens = Lens(camera["width"], camera["height"], camera["focal_px"], k1=camera["k1"])
            cameras.setdefault(name, Camera(center, to_grid.rotation @ np.array(camera["rotation"]), lens))
        points = np.array(model["points"]).reshape(-1, 3)
        heights.append(to_grid.apply(points)[:, 2])
    known = np.concatenate(heights) if heights else np.zeros(0)
    if not len(known):
        raise OrthoSwarmError("no model has enough cameras and points to be georeferenced by recorded positions")
    return cameras, float(np.median(known))


def lay_on_reference(picture: Path, reference: Path, out: Path) -> int:
    """Warp a mosaic onto the reference by one homography, ignoring its own georeference; writes a GeoTIFF (RGBA).

    The homography is estimated automatically from SIFT matches between both (MAGSAC). Since it is fitted to the truth,
    the comparison afterwards measures only the mosaic's internal geometry, in its favour.

    Args:
        picture: RGB or RGBA file; black or transparent pixels are empty.
        reference: the true map. out: the file to write.

    Returns:
        Number of matches that agree.

    Raises:
        OrthoSwarmError: if the mosaic cannot be registered.
    """
    import cv2
    import rasterio
    from rasterio.enums import ColorInterp

    rgb, _ = _colours(picture, None)
    small, per_small = _colours(picture, _MATCHED_PX)
    ground, per_ground = _colours(reference, _MATCHED_PX)
    h, inliers = find_homography(*(cv2.cvtColor(c, cv2.COLOR_RGB2GRAY) for c in (small, ground)))
    h = _enlarged(per_ground) @ h @ np.linalg.inv(_enlarged(per_small))
    with rasterio.open(reference) as file:
        profile = {"crs": file.crs, "transform": file.transform, "width": file.width, "height": file.height}
    bands = np.dstack([rgb, (rgb.max(2) > 0).astype(np.uint8) * 255])
    warped = cv2.warpPerspective(bands, h, (profile["width"], profile["height"]), flags=cv2.INTER_LINEAR)
    warped[warped[..., 3] < 255] = 0
    with rasterio.open(
        out, "w", driver="GTiff", count=4, dtype="uint8", compress="deflate", tiled=True, **profile
    ) as f:
        f.write(np.moveaxis(warped, -1, 0))
        f.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    return inliers


def _colours(path: Path, most: int | None) -> tuple[Bytes, Array]:
    """RGB (rows, columns, 3) of a file, black where it is empty, reduced to at most `most` pixels.

    Also returns the width and height of a reduced pixel in pixels of the file.
    """
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioIOError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            file = rasterio.open(path)
    except RasterioIOError:
        raise OrthoSwarmError(f"{path.name} cannot be read as a picture") from None
    with file:
        shrink = max(1.0, (file.width * file.height / (most or np.inf)) ** 0.5)
        shape = (max(1, int(file.height / shrink)), max(1, int(file.width / shrink)))
        which = [1, 2, 3] if file.count >= 3 else [1, 1, 1]
        bands = file.read(which, out_shape=(3, *shape), resampling=rasterio.enums.Resampling.average)
        bands = np.where(file.dataset_mask(out_shape=shape) > 0, bands, 0)
        per = np.array([file.width / shape[1], file.height / shape[0]])
    return np.ascontiguousarray(np.moveaxis(bands, 0, -1).astype(np.uint8)), per


def _enlarged(per: Array) -> Array:
    """Transformation (3, 3) from pixels of a reduced picture to those of the full one; pixel centres at integers."""
    x, y = per
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])


def find_homography(picture: Bytes, ground: Bytes) -> tuple[Array, int]:
    """The homography from a grey picture to a grey map by SIFT matches, and the number of inliers.

    Raises:
        OrthoSwarmError: for fewer than forty inliers.
    """
    import cv2

    lost = OrthoSwarmError("its mosaic could not be registered on the true map")
    sift = cv2.SIFT_create(nfeatures=20000)  # type: ignore[attr-defined,unused-ignore]
    (here, own), (there, other) = sift.detectAndCompute(picture, None), sift.detectAndCompute(ground, None)
    if own is None or other is None or len(own) < 2 or len(other) < 2:
        raise lost
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
    pairs = [p for p in matcher.knnMatch(own, other, k=2) if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
    if len(pairs) < _LEAST_INLIERS:
        raise lost
    a = np.array([here[p[0].queryIdx].pt for p in pairs])
    b = np.array([there[p[0].trainIdx].pt for p in pairs])
    try:
        h, mask = cv2.findHomography(a, b, cv2.USAC_MAGSAC, 8.0, maxIters=20000, confidence=0.9999)
    except cv2.error:  # OpenCV 5 raises an error where it finds no homography
        raise lost from None
    if h is None or int(mask.sum()) < _LEAST_INLIERS:
        raise lost
    return np.asarray(h, float), int(mask.sum())
