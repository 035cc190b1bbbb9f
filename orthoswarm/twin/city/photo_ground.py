"""A real place as the twin's ground: an orthoimage, a surface model (DSM) and, if there is one, a terrain model."""

from typing import Any

import numpy as np

from orthoswarm.model.arrays import Array, Bytes, Flags, Floats
from orthoswarm.model.errors import InputError
from orthoswarm.twin.city.procedural_noise import noise_field
from orthoswarm.twin.city.scene import CELL_M, PHOTO, TEXEL_M, TREE, Scene, scene_grid


def _open(path: str, what: str) -> Any:
    import rasterio
    from rasterio.errors import RasterioIOError

    try:
        file = rasterio.open(path)
    except RasterioIOError as error:
        raise InputError(f"the {what} {path} cannot be read ({error}); give a GeoTIFF") from None
    if file.crs is None or not file.crs.is_projected or file.crs.to_epsg() is None:
        raise InputError(f"the {what} {path} has no projected CRS with an EPSG code; warp it to UTM first")
    return file


def ground_place(ground: tuple[str, str, str]) -> tuple[int, tuple[float, float], tuple[float, float]]:
    """EPSG code, centre and size (east, north) of a real place; `ground` as in `load_ground`."""
    with _open(ground[0], "orthoimage") as file:
        b = file.bounds
        center = (float(round((b.left + b.right) / 2)), float(round((b.bottom + b.top) / 2)))
        return int(file.crs.to_epsg()), center, (float(b.right - b.left), float(b.top - b.bottom))


def _heights(path: str, what: str) -> tuple[Floats, Any, int]:
    """Heights (NaN where unknown), transform and EPSG; uint16 values v mean 100 + v / 100 m, 65535 no data."""
    with _open(path, what) as file:
        raw = file.read(1)
        z = raw.astype(np.float32)
        if raw.dtype == np.uint16:
            z = 100.0 + z / 100.0
            z[raw == 65535] = np.nan
        elif file.nodata is not None:
            z[raw == file.nodata] = np.nan
        return z, file.transform, int(file.crs.to_epsg())


def _fill(z: Floats) -> Floats:
    """Fill unknown cells with the height of the nearest known cell."""
    from scipy.ndimage import distance_transform_edt

    unknown = np.isnan(z)
    if not unknown.any():
        return z
    index = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(z[tuple(index)], np.float32)


def load_ground(ground: tuple[str, str, str], center: tuple[float, float], half: tuple[float, float]) -> Scene:
    """A scene of a real place around a centre; beyond the data's border it is mirrored.

    Heights are relative to the median of the bare ground, which becomes the takeoff level. The orthoimage keeps its
    own shadows: light it with `ambient` near 1.

    Args:
        ground: paths of orthoimage, surface model and terrain model (empty: the lower envelope of the surface model).
        center: grid coordinates in the orthoimage's CRS. half: half extent, east and north, in metres.

    Raises:
        InputError: for files without a common projected CRS.
    """
    import cv2

    with _open(ground[0], "orthoimage") as file:
        epsg = int(file.crs.to_epsg())
        image = np.moveaxis(file.read([1, 2, 3] if file.count >= 3 else [1, 1, 1]), 0, 2)
        place = file.transform
    dsm, dsm_place, dsm_epsg = _heights(ground[1], "surface model")
    if dsm_epsg != epsg:
        raise InputError(f"orthoimage and surface model have different CRS ({epsg}, {dsm_epsg}); warp one to the other")
    top, left, bottom, right = _solid_part(image)
    image = np.ascontiguousarray(image[top:bottom, left:right])
    place = place * place.translation(left, top)
    dsm = cv2.medianBlur(_fill(dsm), 5)  # without wires, poles and gaps in crowns, which would render as spikes
    scene = Scene.blank(scene_grid(epsg, center, *half))
    surface = _sample(dsm, dsm_place, scene, step=CELL_M, border=image.shape, frame=place)
    if ground[2]:
        bare, bare_place, _ = _heights(ground[2], "bare ground")
        dtm = _sample(_fill(bare), bare_place, scene, step=CELL_M, border=image.shape, frame=place)
    else:
        # Bare ground from the surface: morphological opening over 60 m, smoothed.
        small = cv2.erode(
            cv2.resize(surface, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA), np.ones((15, 15))
        )
        opened = cv2.GaussianBlur(cv2.dilate(small, np.ones((15, 15))), (0, 0), 3.0)
        dtm = np.asarray(cv2.resize(opened, (surface.shape[1], surface.shape[0]), interpolation=cv2.INTER_LINEAR))
    level = float(np.median(dtm))
    scene.dtm[:] = np.minimum(dtm, surface) - level
    scene.dsm[:] = surface - level
    scene.albedo[:] = np.clip(
        _sample(image.astype(np.float32), place, scene, step=TEXEL_M, border=image.shape, frame=place), 0, 255
    )
    _classify(scene)
    _sharpen(scene)
    return scene


def _solid_part(image: Bytes) -> tuple[int, int, int, int]:
    """Rows and columns (top, left, bottom, right) of the part without the black wedges of a rotated orthoimage."""
    valid: Flags = np.asarray(image[::4, ::4].any(axis=2))
    top, left, bottom, right = 0, 0, *valid.shape
    while bottom - top > 8 and right - left > 8:
        part = valid[top:bottom, left:right]
        shares = [float(rim.mean()) for rim in (part[0], part[-1], part[:, 0], part[:, -1])]
        worst = int(np.argmin(shares))
        if shares[worst] > 0.98:
            break
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return 4 * top, 4 * left, 4 * bottom, 4 * right


def _sample(data: Any, place: Any, scene: Scene, *, step: float, border: tuple[int, ...], frame: Any) -> Floats:
    """Bilinear values of a raster at the scene's cells of side `step`; positions beyond the orthoimage are mirrored."""
    import cv2

    g = scene.grid
    cols, rows = (round(n * TEXEL_M / step) for n in (g.width, g.height))
    east = g.west + (np.arange(cols) + 0.5) * step
    north = g.north - (np.arange(rows) + 0.5) * step
    width, height = border[1] * frame.a, border[0] * -frame.e
    east = frame.c + _mirror(east - frame.c, width)
    north = frame.f - _mirror(frame.f - north, height)
    x = ((east - place.c) / place.a - 0.5).astype(np.float32)
    y = ((north - place.f) / place.e - 0.5).astype(np.float32)
    out = np.empty((rows, cols, *data.shape[2:]), np.float32)
    for r in range(0, rows, 512):
        my = np.repeat(y[r : r + 512, None], cols, axis=1)
        mx = np.repeat(x[None, :], my.shape[0], axis=0)
        out[r : r + 512] = cv2.remap(data, mx, my, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out


def _mirror(x: Array, length: float) -> Array:
    m = np.mod(x, 2.0 * length)
    return np.asarray(np.where(m > length, 2.0 * length - m, m))


def _classify(scene: Scene) -> None:
    """Kinds and wall colours guessed from the image: high and green is a tree, walls are a darker shade of the roof."""
    import cv2

    scene.kind[:] = PHOTO
    small = cv2.resize(scene.albedo, (scene.dsm.shape[1], scene.dsm.shape[0]), interpolation=cv2.INTER_AREA)
    r, g, b = (small[..., i].astype(np.int16) for i in range(3))
    high = scene.above_ground() > 2.5
    green = (2 * g - r - b) > 6
    scene.facade[:] = high & ~green & (scene.above_ground() > 4.0)
    scene.wall[:] = np.where((high & ~green)[..., None], 0.5 * small + 70.0, 0.72 * small).astype(np.uint8)
    tree = (high & green).astype(np.uint8)
    scene.kind[np.repeat(np.repeat(tree, 2, axis=0), 2, axis=1) > 0] = TREE


def _sharpen(scene: Scene) -> None:
    """Restore the contrast lost in resampling, and add a little grain finer than the orthoimage's resolution."""
    import cv2

    rows = scene.albedo.shape[0]
    for r in range(0, rows, 1024):
        part = scene.albedo[r : r + 1024].astype(np.float32)
        part += 0.6 * (part - cv2.GaussianBlur(part, (0, 0), 1.6))
        part += 5.0 * noise_field((part.shape[0], part.shape[1]), TEXEL_M, 0.9, 2, 7919 + r)[..., None]
        scene.albedo[r : r + 1024] = np.clip(part, 0, 255)
