"""Offset of the map against the vehicles' receivers, and whether the receivers' errors explain it.

Each vehicle's mean difference is one observation of the offset; its sigma consists of the receiver's own bias
(multipath, the satellites it tracks) and of its drift. The error that all receivers share at a time and place
(ionosphere) does not become smaller with more vehicles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.refine.bundle.covariance import RECEIVER_BIAS_SIGMA_M, RECEIVER_COMMON_SIGMA_M

_CORRECTED_SIGMA_M: Final = 0.5  # a position that states at most this sigma was corrected (RTK, PPK)
_CORRECTED_FLOOR_M: Final = 0.05  # corrected positions are not trusted better than this: antenna offset, base station
_OFFSET_OUTLIER: Final = 5.0  # differences of more than so many median distances from the median are gross errors
_OFFSET_PROBABILITY: Final = 0.01  # a right map is doubted with this probability only


@dataclass(frozen=True, slots=True)
class MapOffset:
    """The map against the receivers.

    east, north: metres from where the receivers say to where the map shows the same ground. sigma: of both. vehicles:
    how many were compared. corrected: receivers state an accuracy that only corrections (RTK, PPK) give.
    """

    east: float
    north: float
    sigma: float
    vehicles: int
    corrected: bool

    @property
    def distance(self) -> float:
        """Metres."""
        return float(np.hypot(self.east, self.north))

    @property
    def by_chance(self) -> float:
        """Probability of at least this distance if the map lies where it should (both axes Gaussian)."""
        return float(np.exp(-0.5 * (self.distance / self.sigma) ** 2))

    @property
    def doubted(self) -> bool:
        """Whether the receivers' errors do not explain it."""
        return self.by_chance < _OFFSET_PROBABILITY

    def explains(self, east: float, north: float) -> bool:
        """Whether receivers' errors of this size would explain another offset, metres."""
        return replace(self, east=east, north=north).by_chance >= _OFFSET_PROBABILITY

    def document(self) -> dict[str, float | int | bool]:
        """As JSON values: `east`, `north`, `sigma` in metres, `vehicles`, `doubted`."""
        return {
            "east": self.east, "north": self.north, "sigma": self.sigma, "vehicles": self.vehicles,
            "doubted": self.doubted,
        }  # fmt: skip

    def warning(self) -> list[str]:
        """One sentence where the receivers' errors do not explain the offset, else none."""
        if not self.doubted:
            return []
        probably = (
            "the map is probably misplaced, for the receivers had corrections"
            if self.corrected
            else "the map or all receivers are wrong, and that these vehicles agree speaks against the map"
            if self.vehicles > 2
            else "the map or the receivers are wrong"
        )
        return [
            f"the basemap lies {self.distance:.1f} m ({self.east:+.1f} east, {self.north:+.1f} north) from where the "
            f"receivers say, which are good to {self.sigma:.1f} m (one sigma, {_count(self.vehicles)}): {probably}; "
            "the orthoimage follows the basemap, so compare it with surveyed "
            "points (evaluate --checkpoints FILE), or give a few of them to place it on (mosaic --control FILE)"
        ]


def control_warning(control: MapOffset, on_map: MapOffset | None, shift_m: Array | None) -> list[str]:
    """One sentence where neither the receivers' errors nor a map explain where control points lie, else none.

    control: the frames that control points placed, against the receivers. on_map: the map against the receivers.
    shift_m: float64 (2,), by which control points move what lies on the map; None without such photos.
    """
    if not control.doubted:
        return []
    agrees = ""
    if on_map is not None and shift_m is not None:
        if on_map.explains(*shift_m.tolist()):
            return []  # map and points speak against the receivers
        if not on_map.doubted:
            agrees = f", and {np.hypot(*shift_m):.1f} m from the basemap, which agrees with the receivers"
    return [
        f"the control points lie {control.distance:.1f} m ({control.east:+.1f} east, {control.north:+.1f} north) from "
        f"where the receivers say, which are good to {control.sigma:.1f} m (one sigma, {_count(control.vehicles)})"
        f"{agrees}: check the datum, coordinate system and zone of the points; the orthoimage follows them"
    ]


def had_corrections(frames: Sequence[Frame]) -> bool:
    """Whether a vehicle's receiver states an accuracy that only corrections (RTK, PPK) give."""
    stated = [np.inf if f.fix.position_sigma_m is None else f.fix.position_sigma_m for f in frames]
    return float(np.median(stated)) <= _CORRECTED_SIGMA_M


def measure_map_offset(recorded: Sequence[PlacedFrame], refined: Sequence[PlacedFrame]) -> MapOffset | None:
    """The offset of the map against the receivers, by the frames that were refined on the map; None without any."""
    on_map = [p for p in refined if p.stage == "fine"]
    return measure_control_offset(recorded, on_map, min((p.sigma_m for p in on_map), default=0.0))


def measure_control_offset(
    recorded: Sequence[PlacedFrame], refined: Sequence[PlacedFrame], found_sigma_m: float
) -> MapOffset | None:
    """The offset of well placed frames against their receivers, or None; found_sigma_m: of the frames' common place."""
    before = {(p.frame.vehicle, p.frame.image): p.camera.nadir for p in recorded if p.frame.has_own_position}
    moved: dict[str, list[Array]] = {}
    stated: dict[str, list[float]] = {}
    for p in (p for p in refined if not p.weak):
        was = before.get((p.frame.vehicle, p.frame.image))
        if was is not None:
            moved.setdefault(p.frame.vehicle, []).append(p.camera.nadir - was)
            stated.setdefault(p.frame.vehicle, []).append(p.frame.fix.position_sigma_m or np.inf)
    if not moved:
        return None
    accuracy = {vehicle: float(np.median(values)) for vehicle, values in stated.items()}
    corrected = {v for v, s in accuracy.items() if s <= _CORRECTED_SIGMA_M}
    used = sorted(corrected or moved)
    means, sigmas = [], []
    for vehicle in used:
        vectors = np.array(moved[vehicle])
        away = np.hypot(*(vectors - np.median(vectors, axis=0)).T)
        inliers = vectors[away <= _OFFSET_OUTLIER * max(float(np.median(away)), 1e-6)]
        means.append(inliers.mean(axis=0))
        spread = float(np.sqrt(inliers.var(axis=0).mean()))
        own = max(accuracy[vehicle], _CORRECTED_FLOOR_M) if corrected else RECEIVER_BIAS_SIGMA_M
        sigmas.append(np.hypot(own, spread))
    offset, sigma = _together(np.array(means), np.array(sigmas))
    common = 0.0 if corrected else RECEIVER_COMMON_SIGMA_M
    sigma = float(np.linalg.norm([sigma, common, found_sigma_m]))
    return MapOffset(float(offset[0]), float(offset[1]), sigma, len(used), bool(corrected))


def _together(means: Array, sigmas: Array) -> tuple[Array, float]:
    """Weighted mean (2,) and its sigma, larger where the vehicles differ by more than their sigmas (Birge ratio)."""
    weight = 1.0 / sigmas**2
    offset = (weight[:, None] * means).sum(axis=0) / weight.sum()
    variance = 1.0 / weight.sum()
    if len(means) > 1:
        chi2 = float((weight[:, None] * (means - offset) ** 2).sum()) / (2 * (len(means) - 1))
        variance *= max(1.0, chi2)
    return offset, float(np.sqrt(variance))


def _count(vehicles: int) -> str:
    return "1 vehicle" if vehicles == 1 else f"{vehicles} vehicles"
