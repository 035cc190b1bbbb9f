"""Pictures that cannot be refined: too few of their camera, or all taken from one position.

They stay as recorded, or move as their solved neighbours did.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags
from orthoswarm.model.camera import Camera
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import PlacedFrame

BeforeAfter = tuple[PlacedFrame, PlacedFrame]
"""A frame as recorded and as solved."""

_LEAST_PHOTOS_OF_KIND: Final = 3  # fewer photos of one camera and size are not refined but placed by their neighbours
_HOVER_SHARE: Final = 0.05  # a vehicle whose positions spread by less than this share of its height hovers
_WANDER_SHARE: Final = 0.3  # ... also if they spread by less than this share, but as a receiver's noise does
_WANDER_STEPS: Final = 0.9  # noise: steps are longer than this share of the positions' rms spread
_WANDER_PHOTOS: Final = 6  # least photos to tell noise from a way
_UNSOLVED_NEIGHBOURS: Final = 5  # solved neighbours by which an unsolved picture is placed
_UNSOLVED_SIGMA_M: Final = 2.0  # added in squares to the largest sigma of those neighbours


@dataclass(frozen=True, slots=True)
class RefinableSplit:
    """Recorded frames by whether a refiner can solve them, each in the frames' order, and warnings for the report.

    fit: frames that it can solve. odd: too few of their camera and size, to be placed by their neighbours. still:
    frames of vehicles that hovered for all pictures, which stay as recorded.
    """

    fit: list[PlacedFrame]
    odd: list[PlacedFrame]
    still: list[PlacedFrame]
    warnings: list[str]


def split_refinable(recorded: Sequence[PlacedFrame]) -> RefinableSplit:
    """Separate the frames on which a refiner would fail, or silently give a wrong result."""
    spots = hovering_vehicles(recorded)
    warnings = [
        f"{vehicle}: all pictures were taken at one spot; they are placed as recorded" for vehicle in sorted(spots)
    ]
    moving = [p for p in recorded if p.frame.vehicle not in spots]
    few = few_of_their_kind([p.frame for p in moving])
    odd = [p for p, alone in zip(moving, few, strict=True) if alone]
    if odd:
        some = len(odd) > 1
        who, follow = (f"{len(odd)} pictures", "follow their") if some else ("1 picture", "follows its")
        warnings.append(f"{who} of another camera or size, too few to be refined, {follow} neighbours")
    fit = [p for p, alone in zip(moving, few, strict=True) if not alone]
    return RefinableSplit(fit, odd, [p for p in recorded if p.frame.vehicle in spots], warnings)


def few_of_their_kind(frames: Sequence[Frame]) -> Flags:
    """Frames with too few others of their vehicle, camera and size, while other cameras have enough: bool (N,)."""
    kinds = [(f.vehicle, f.camera, f.width, f.height) for f in frames]
    count = Counter(kinds)
    few = np.array([count[kind] < _LEAST_PHOTOS_OF_KIND for kind in kinds], bool)
    return few if not few.all() else np.zeros(len(frames), bool)


def hovering_vehicles(recorded: Sequence[PlacedFrame]) -> set[str]:
    """Vehicles with several pictures (in order of time) that were all taken from one position."""
    members: dict[str, list[PlacedFrame]] = {}
    for p in recorded:
        members.setdefault(p.frame.vehicle, []).append(p)
    return {
        vehicle
        for vehicle, own in members.items()
        if len(own) > _LEAST_PHOTOS_OF_KIND and _hovers(np.array([p.camera.position for p in own]))
    }


def _hovers(positions: Array) -> bool:
    """True if a path (N, 3) is one position with a receiver's noise: steps as long as the total spread."""
    spread = float(np.hypot(*np.subtract(*np.percentile(positions[:, :2], [95, 5], axis=0))))
    height = float(np.median(positions[:, 2]))
    if spread < _HOVER_SHARE * height:
        return True
    rms = float(np.sqrt(((positions[:, :2] - positions[:, :2].mean(0)) ** 2).sum(1).mean()))
    steps = float(np.sqrt((np.diff(positions[:, :2], axis=0) ** 2).sum(1).mean()))
    return len(positions) >= _WANDER_PHOTOS and spread < _WANDER_SHARE * height and steps > _WANDER_STEPS * rms


def place_by_neighbours(
    odd: Sequence[PlacedFrame], recorded: Sequence[PlacedFrame], refined: Sequence[PlacedFrame]
) -> list[PlacedFrame]:
    """Place frames by applying the refinement's changes of their nearest neighbours: position, attitude, focal length.

    odd: as recorded; they stay so if nothing was refined. recorded: the refined frames as recorded, with the same
    assumed field of view. refined: after refinement.
    """
    before = {p.frame.image: p for p in recorded}
    pairs = [(before[p.frame.image], p) for p in refined if p.frame.image in before]
    pairs = [pair for pair in pairs if not pair[1].weak] or pairs
    return [_moved_with(one, pairs) for one in odd] if pairs else list(odd)


def move_with_neighbours(
    extra: Sequence[PlacedFrame], before: Sequence[PlacedFrame], after: Sequence[PlacedFrame]
) -> list[PlacedFrame]:
    """Move frames that were not solved with the others as their nearest neighbours moved since; sigmas stay."""
    own = {p.frame.image for p in extra}
    moved = place_by_neighbours(extra, [p for p in before if p.frame.image not in own], after)
    return [replace(now, sigma_m=was.sigma_m, weak=was.weak) for was, now in zip(extra, moved, strict=True)]


def _moved_with(one: PlacedFrame, pairs: Sequence[BeforeAfter]) -> PlacedFrame:
    """A frame moved by the median shift of the nearest ones, of its vehicle if any, and turned like the first."""
    own = [pair for pair in pairs if pair[0].frame.vehicle == one.frame.vehicle] or pairs
    away = [float(np.hypot(*(p.camera.nadir - one.camera.nadir))) for p, _ in own]
    near = [own[i] for i in np.argsort(away, kind="stable")[:_UNSOLVED_NEIGHBOURS]]
    shift = np.median([after.camera.position - old.camera.position for old, after in near], axis=0)
    old, after = near[0]
    turn = after.camera.rotation @ old.camera.rotation.T
    ratio = float(np.median([a.camera.lens.focal_px / o.camera.lens.focal_px for o, a in near]))
    lens = replace(one.camera.lens, focal_px=one.camera.lens.focal_px * ratio)
    camera = Camera(one.camera.position + shift, turn @ one.camera.rotation, lens)
    sigma = float(np.hypot(max(a.sigma_m for _, a in near), _UNSOLVED_SIGMA_M))
    return PlacedFrame(one.frame, camera, after.stage, sigma, weak=True)
