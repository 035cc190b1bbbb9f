"""A rectangle on the ground along the axes of a grid: the one value type for bounds."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class BoundingBox(NamedTuple):
    """West, south, east, north edges of a rectangle, metres in a projected CRS (or in the block's local frame).

    A named tuple, so that it unpacks, compares and goes to JSON as its four numbers in this order.

        box = BoundingBox(0.0, 0.0, 30.0, 20.0)
        assert box.width == 30.0 and box.grown(5.0) == (-5.0, -5.0, 35.0, 25.0)
        assert box.intersection(BoundingBox(40.0, 0.0, 50.0, 20.0)).empty
    """

    west: float
    south: float
    east: float
    north: float

    @classmethod
    def around(cls, boxes: "Sequence[BoundingBox] | NDArray[np.float64]") -> "BoundingBox":
        """The smallest box that holds all boxes: BoundingBoxes or an array (n, 4), at least one."""
        edges = np.asarray(boxes, float).reshape(-1, 4)
        west, south = edges[:, :2].min(0)
        east, north = edges[:, 2:].max(0)
        return cls(float(west), float(south), float(east), float(north))

    @classmethod
    def around_points(cls, east_north: ArrayLike, margin_m: float = 0.0) -> "BoundingBox":
        """The smallest box that holds ground points (..., 2), grown by a margin."""
        points = np.asarray(east_north, float).reshape(-1, 2)
        (west, south), (east, north) = points.min(0) - margin_m, points.max(0) + margin_m
        return cls(float(west), float(south), float(east), float(north))

    @property
    def width(self) -> float:
        """Extent from west to east; negative where an intersection is empty."""
        return self.east - self.west

    @property
    def height(self) -> float:
        """Extent from south to north; negative where an intersection is empty."""
        return self.north - self.south

    @property
    def center(self) -> tuple[float, float]:
        """East and north of the middle."""
        return 0.5 * (self.west + self.east), 0.5 * (self.south + self.north)

    @property
    def empty(self) -> bool:
        """True for an intersection of boxes that share no area."""
        return self.west >= self.east or self.south >= self.north

    def grown(self, margin_m: float) -> "BoundingBox":
        """The box with a margin on all four sides."""
        return BoundingBox(self.west - margin_m, self.south - margin_m, self.east + margin_m, self.north + margin_m)

    def moved(self, east_m: float, north_m: float) -> "BoundingBox":
        """The box shifted, for example from a block's local frame to the grid."""
        return BoundingBox(self.west + east_m, self.south + north_m, self.east + east_m, self.north + north_m)

    def intersection(self, other: "BoundingBox") -> "BoundingBox":
        """The intersection of two boxes; `empty` if they do not overlap."""
        return BoundingBox(
            max(self.west, other.west), max(self.south, other.south),
            min(self.east, other.east), min(self.north, other.north),
        )  # fmt: skip

    def contains(self, other: "BoundingBox") -> bool:
        """True if another box lies within this one; edges may touch."""
        return (
            self.west <= other.west
            and self.south <= other.south
            and other.east <= self.east
            and other.north <= self.north
        )

    def overlaps(self, other: "BoundingBox") -> bool:
        """True if two boxes share area, and not only an edge."""
        return self.gap_m(other) < 0.0

    def gap_m(self, other: "BoundingBox") -> float:
        """Distance of two boxes, the larger of both axes; 0 if they touch, negative if they overlap."""
        return max(
            self.west - other.east, other.west - self.east,
            self.south - other.north, other.south - self.north,
        )  # fmt: skip
