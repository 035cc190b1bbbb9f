"""How a player turns a video's pictures: the display matrix that phones and some drones write beside them.

Sensors are read out in one way whatever way the camera is held; the matrix says how the picture has to be turned so
that it stands upright.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.camera import angles_from_rotation, focal_px, fov_rad, rotation_from_angles
from telemetry.samples.sample import Sample

_ONE = 65536.0  # the number one in the matrix (16.16 fixed point, ISO/IEC 14496-12, 6.2.2)
_WITHIN = 0.05  # A matrix that is farther than this from quarter turns and mirrors is not one of a camera


@dataclass(frozen=True, slots=True)
class Turn:
    """Quarter turns and mirrors: column and row as shown are (xx x + xy y, yx x + yy y) of those as coded, centred.

    Each of the four is -1, 0 or 1.
    """

    xx: int = 1
    xy: int = 0
    yx: int = 0
    yy: int = 1

    @property
    def is_none(self) -> bool:
        """Whether pictures are shown as they are coded."""
        return (self.xx, self.xy, self.yx, self.yy) == (1, 0, 0, 1)

    @property
    def is_mirrored(self) -> bool:
        """Whether left and right are exchanged, as by the front cameras of phones."""
        return self.xx * self.yy - self.xy * self.yx < 0

    @property
    def clockwise_deg(self) -> int:
        """The turn, 0 to 270 degrees (of a mirrored picture, that of its rows)."""
        return round(math.degrees(math.atan2(self.yx, self.xx))) % 360

    def picture(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture (rows, columns, ...) as shown, of one as coded."""
        if self.xx == 0:
            pixels = np.swapaxes(pixels, 0, 1)
        if self.xx + self.xy < 0:
            pixels = pixels[:, ::-1]
        if self.yx + self.yy < 0:
            pixels = pixels[::-1]
        return np.ascontiguousarray(pixels)

    def sample(self, sample: Sample, columns: int, rows: int) -> Sample:
        """The pose of a picture as shown, of one that describes the picture as coded (of so many columns and rows).

        What is not known stays unknown; in its place nadir and north count. A mirrored camera has no angles.
        """
        if self.is_none:
            return sample
        result = replace(sample)
        if sample.fov_deg is not None and self.xx == 0:
            result.fov_deg = math.degrees(fov_rad(focal_px(math.radians(sample.fov_deg), columns), rows))
        if self.is_mirrored or (sample.yaw_deg is None and sample.pitch_deg is None):
            return result
        coded = rotation_from_angles(
            math.radians(sample.yaw_deg or 0.0),
            math.radians(-90.0 if sample.pitch_deg is None else sample.pitch_deg),
            math.radians(sample.roll_deg or 0.0),
        )
        axes = np.array([[self.xx, self.yx, 0.0], [self.xy, self.yy, 0.0], [0.0, 0.0, 1.0]])
        yaw, pitch, roll = (math.degrees(float(angle)) for angle in angles_from_rotation(coded @ axes))
        result.yaw_deg = None if sample.yaw_deg is None else yaw
        if sample.pitch_deg is not None:
            result.pitch_deg, result.roll_deg = pitch, roll
        return result


AS_CODED = Turn()


def turn_of(frame: Any) -> Turn:
    """How a decoded picture has to be turned; as it is if it says nothing, or nothing that a camera would."""
    from av.sidedata.sidedata import Type

    matrix = next((bytes(data) for data in frame.side_data if data.type == Type.DISPLAYMATRIX), b"")
    if len(matrix) < 36:
        return AS_CODED
    a, b, _, c, d = (value / _ONE for value in np.frombuffer(matrix, "=i4", 5).tolist())
    size = max(abs(a), abs(b), abs(c), abs(d))
    if size == 0.0:
        return AS_CODED
    whole = [round(value / size) for value in (a, b, c, d)]
    near = all(abs(value / size - nearest) <= _WITHIN for value, nearest in zip((a, b, c, d), whole, strict=True))
    xx, yx, xy, yy = whole
    return Turn(xx, xy, yx, yy) if near and abs(xx * yy - xy * yx) == 1 else AS_CODED
