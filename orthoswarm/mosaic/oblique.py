"""Oblique pictures in a nadir flight: good for the adjustment, of no use for an orthoimage.

The far end of such a picture is stretched to ten times its size, and houses lean over whole streets. As no other
picture looks there, the map would be surrounded by that.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import PlacedFrame

_OBLIQUE_DEG: Final = 35.0
"""Pictures that look farther from straight down are left out of a flight that looks straight down: more than a fixed
camera is tilted when its vehicle accelerates (28 degrees measured)."""
_NADIR_DEG: Final = 15.0  # a flight whose median tilt is below this looks straight down
_OBLIQUE_SHARE: Final = 1.0 / 3.0  # a vehicle with a larger share of oblique pictures took them on purpose


def tilts(placed: Sequence[PlacedFrame]) -> Array:
    """Angles (N,) between the middle of each picture's view and straight down, radians."""
    down = np.array([-p.camera.rotation[2, 2] for p in placed], float)
    return np.asarray(np.arccos(np.clip(down, -1.0, 1.0)))


def strays(placed: Sequence[PlacedFrame]) -> dict[str, str]:
    """Pictures that look far off where the others of their vehicle look straight down: image -> why they are left out.

    A vehicle with more than a third of oblique pictures took them on purpose, and keeps them.
    """
    oblique_rad, nadir_rad = float(np.radians(_OBLIQUE_DEG)), float(np.radians(_NADIR_DEG))
    tilt = tilts(placed)
    members: dict[str, list[int]] = {}
    for i, p in enumerate(placed):
        members.setdefault(p.frame.vehicle, []).append(i)
    out = {}
    for index in members.values():
        off = tilt[index] > oblique_rad
        if off.any() and off.mean() <= _OBLIQUE_SHARE and np.median(tilt[index]) < nadir_rad:
            for i in np.array(index)[off].tolist():
                out[placed[i].frame.image] = (
                    f"it looks {np.degrees(tilt[i]):.0f} degrees away from straight down, the others of its vehicle "
                    f"{np.degrees(np.median(tilt[index])):.0f}; it would smear over the map"
                )
    return out


def stray_warning(reasons: dict[str, str]) -> list[str]:
    """The warning about strays that were left out of a map."""
    if not reasons:
        return []
    many = f"{len(reasons)} pictures look" if len(reasons) > 1 else "1 picture looks"
    return [f"{many} strongly tilted among others that look straight down; left out of the map ({min(reasons)} first)"]


def weakly_held_warning(placed: Sequence[PlacedFrame], reported: Sequence[PlacedFrame] = ()) -> list[str]:
    """The warning about pictures with too few observations in the adjustment; they are drawn where no other looks.

    `reported`: pictures that another warning names. There is no warning where all pictures are like that.
    """
    known = {p.frame.image for p in reported}
    weak = sorted(p.frame.image for p in placed if p.weak and p.frame.image not in known)
    if not weak or all(p.weak for p in placed):
        return []
    many = f"{len(weak)} pictures have" if len(weak) > 1 else "1 picture has"
    return [
        f"{many} too little in common with the others to be placed well: drawn only where no other picture shows "
        f"the ground ({weak[0]} first)"
    ]
