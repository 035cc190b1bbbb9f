"""One picture's view of the ground: its camera, the sigma of its position, and the flaws of the picture.

Blurred, damaged and flat pictures are found by comparison with their neighbours in flight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import IntFlag
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera, Lens, focal_px
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.raster.picture_quality import PictureQuality

NEIGHBOURS: Final = 15  # pictures before and after with whose median one is compared
_BLURRED_SHARE: Final = 0.5  # blurred: less than this share of their sharpness
_FAINT_SHARE: Final = 0.25  # haze: less than this share of their contrast ...
_LEAST_CONTRAST: Final = 4.0  # ... or less than this ...
_SATURATED_SHARE: Final = 0.5  # ... or more than this share of the pixels saturated
_FLAT_SHARE: Final = 0.10  # damaged: this share of the blocks more than usual is of one single value


class Flaw(IntFlag):
    """Why a cell does not count as well seen in a view; a view may have several flaws."""

    EDGE = 1
    """Within two sigma of the footprint's edge: it may lie outside."""
    OBLIQUE = 2
    """More than 45 degrees off nadir."""
    BLURRED = 4
    DAMAGED = 8
    HAZE = 16
    """Glare or haze: too little contrast to be matched."""
    POSITION = 32
    """The sigma of the picture's position is larger than required."""
    COARSE = 64
    """The GSD is larger than required."""


NO_FLAW = Flaw(0)
FLAW_NAMES = {
    Flaw.EDGE: "edge of a picture",
    Flaw.OBLIQUE: "oblique",
    Flaw.BLURRED: "blurred",
    Flaw.DAMAGED: "damaged",
    Flaw.HAZE: "haze or glare",
    Flaw.POSITION: "position uncertain",
    Flaw.COARSE: "too coarse",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A picture's data for the coverage."""

    image: str
    vehicle: str
    time_s: float | None  # UTC epoch seconds, None if unknown
    position: Array  # float64 (3,), east, north, height, metres (heights share the datum of the ground)
    to_camera: Array  # float64 (3, 3), from ground point minus position to camera axes (x right, y down, z = depth, m)
    lens: Lens
    sigma_m: float  # horizontal error of its place on the ground, one sigma per axis
    focal_sigma: float = 0.0  # relative error of the focal length, one sigma
    flaws: Flaw = NO_FLAW  # flaws of the complete picture
    placed: bool = True  # True for a refined pose, False for a recorded one
    # the terrain with which the camera was solved, in the datum of its position; None for that of the grid
    ground: Terrain | None = None
    recorded_height_m: float | None = None  # recorded height above the takeoff level, None if unknown

    @classmethod
    def of_camera(
        cls, camera: Camera, image: str, vehicle: str, sigma_m: float, time_s: float | None = None, **more: Any
    ) -> "View":
        """The view of a camera; `more` are further attributes."""
        return cls(
            image=image, vehicle=vehicle, time_s=time_s, position=camera.position, to_camera=camera.rotation.T.copy(),
            lens=camera.lens, sigma_m=sigma_m, **more,
        )  # fmt: skip

    @classmethod
    def of_frame(cls, placed: PlacedFrame, focal_sigma: float = 0.0, ground: Terrain | None = None) -> "View":
        """The view of a placed frame."""
        frame = placed.frame
        return cls.of_camera(
            placed.camera, frame.image, frame.vehicle, placed.sigma_m, frame.time_s,
            focal_sigma=focal_sigma, placed=placed.stage != "realtime", ground=ground,
            recorded_height_m=frame.fix.height_m,
        )  # fmt: skip

    @classmethod
    def of_row(cls, row: Mapping[str, Any], ground_z_m: float, grid: LocalGrid) -> "View":
        """The view of a placed line of frames.jsonl.

        Args:
            row: the line; needs `homography`, `camera`, `fov_deg`, `width` and `height`.
            ground_z_m: height of the plane of its homography. grid: the grid of its homography.

        Raises:
            InputError: something in the line is missing or no number.
        """
        try:
            width, height = int(row["width"]), int(row["height"])
            place = row["camera"]
            position = np.array([*grid.to_grid(place["lat_deg"], place["lon_deg"]), place["height_m"]], float)
            homography = np.array(row["homography"], float).reshape(3, 3)
            lens = Lens(
                width, height, focal_px(np.radians(row["fov_deg"]), width), k1=row.get("k1", 0.0), k2=row.get("k2", 0.0)
            )
            sigma = float("nan") if row["sigma_m"] is None else float(row["sigma_m"])
            recorded = row.get("recorded_height_m")
            recorded_m = None if recorded is None else float(recorded)
            to_camera = _to_camera(homography, position, lens, ground_z_m)
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise InputError(
                f"the line of {row.get('image')} in frames.jsonl has no usable {error}; make the map again with "
                "this version of `orthoswarm mosaic`"
            ) from None
        when = row.get("time")
        time_s = None if when is None else datetime.fromisoformat(when).timestamp()
        return cls(
            image=str(row["image"]), vehicle=str(row["vehicle"]), time_s=time_s, position=position, to_camera=to_camera,
            lens=lens, sigma_m=sigma, placed=row["stage"] != "realtime", recorded_height_m=recorded_m,
        )  # fmt: skip

    def moved_to(self, position: Array, image: str, time_s: float | None = None) -> "View":
        """The same camera at another position: for a picture that was not taken or has not arrived."""
        return replace(self, position=position, image=image, time_s=time_s)

    def with_fov(self, fov_rad: float) -> "View":
        """The same view through a lens without distortion of another horizontal field of view."""
        lens = self.lens
        return replace(self, lens=Lens(lens.width, lens.height, focal_px(fov_rad, lens.width)))

    @property
    def fov_rad(self) -> float:
        """Horizontal field of view, radians."""
        return self.lens.fov_rad


def _to_camera(homography: Array, position: Array, lens: Lens, ground_z_m: float) -> Array:
    """The matrix of `View.to_camera` from a homography (pixel, distortion removed -> east, north on a plane).

    A ground point minus the position, d, lies on the plane for d_z = drop; (east, north, 1) is then linear in d, and
    since all of it is homogeneous in d the matrix holds for points of every height.
    """
    drop = ground_z_m - position[2]
    from_offset = np.array([[1.0, 0.0, position[0] / drop], [0.0, 1.0, position[1] / drop], [0.0, 0.0, 1.0 / drop]])
    centred = Lens(lens.width, lens.height, lens.focal_px)
    matrix = np.linalg.inv(centred.matrix()) @ np.linalg.inv(homography) @ from_offset
    matrix /= np.linalg.norm(matrix[2])
    return np.asarray(matrix if matrix[2, 2] * drop > 0.0 else -matrix)


def picture_flaws(qualities: Sequence[PictureQuality | None]) -> list[Flaw]:
    """Flaws of one camera's pictures, in flying order; none for a picture that was not measured.

    Blurred: less than half as sharp as the median of the 15 pictures before and after. Haze: less than a quarter of
    their median contrast, or less than 4 grey levels, or half of the pixels saturated. Damaged: the share of blocks of
    one single value exceeds their median by a tenth. The thresholds are ours; sharpness over a wood and over a lake
    differs by less.
    """
    flaws = [Flaw(0)] * len(qualities)
    measured = [i for i, q in enumerate(qualities) if q is not None]
    if not measured:
        return flaws
    rows = [(q.sharpness, q.contrast, q.flat_share, q.saturated_share) for q in qualities if q is not None]
    sharp, contrast, flat, bright = np.array(rows, float).T
    usual_sharp, usual_contrast, usual_flat = (_running_median(v) for v in (sharp, contrast, flat))
    for k, i in enumerate(measured):
        if sharp[k] < _BLURRED_SHARE * usual_sharp[k]:
            flaws[i] |= Flaw.BLURRED
        if contrast[k] < max(_LEAST_CONTRAST, _FAINT_SHARE * usual_contrast[k]) or bright[k] > _SATURATED_SHARE:
            flaws[i] |= Flaw.HAZE
        if flat[k] > usual_flat[k] + _FLAT_SHARE:
            flaws[i] |= Flaw.DAMAGED
    return flaws


def _running_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    n = NEIGHBOURS
    return np.array([np.median(values[max(0, i - n) : i + n + 1]) for i in range(len(values))])
