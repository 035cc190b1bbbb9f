"""Key pictures: those of a flight that are drawn where pictures overlap by far more than a map needs.

Of pictures a few metres apart each wins a strip of some metres between two seams. All must be read for that, and every
seam may cut what moves or stands high.
"""

from collections.abc import Collection, Sequence
from itertools import groupby
from typing import Final

import numpy as np

from orthoswarm.model.camera import fov_rad
from orthoswarm.model.placement import PlacedFrame

_CHANGE_SHARE: Final = 0.12
"""Most by which the view changes from one key picture to the next, of the field of view along the shorter side
(docs/benchmarks.md: error and cost by it)."""
_USED_CHANGE_SHARE: Final = 0.15  # the same to a picture that is preferred: refined poses differ from recorded ones


def key_pictures(placed: Sequence[PlacedFrame], ground_z_m: float, used: Collection[str] = ()) -> list[PlacedFrame]:
    """The pictures of a map without those whose view is nearly that of the key pictures before and after them.

    Weak and damaged pictures are always among them, since they are drawn where no other sees.

    Args:
        placed: frames, vehicle by vehicle, in flying order. ground_z_m: level of the ground, same datum as the cameras.
        used: names of pictures that are preferred.
    """
    good = [p for p in placed if not (p.weak or p.frame.damaged)]
    left_out = {p.frame.image for p in good}
    for _, flight in groupby(good, key=lambda p: p.frame.vehicle):
        members, at = list(flight), 0
        while at < len(members):
            left_out.discard(members[at].frame.image)
            at = _next(members, at, ground_z_m, used)
    return [p for p in placed if p.frame.image not in left_out]


def _next(flight: Sequence[PlacedFrame], at: int, ground_z_m: float, used: Collection[str]) -> int:
    """The last picture that shows nearly what picture `at` shows, preferred ones before others; at least the next."""
    found, preferred = at + 1, 0
    for j in range(at + 1, len(flight)):
        change = _view_change(flight[at], flight[j], ground_z_m)
        if change > _USED_CHANGE_SHARE:
            break
        if flight[j].frame.image in used:
            preferred = j
        elif change <= _CHANGE_SHARE:
            found = j
    return preferred or found


def _view_change(a: PlacedFrame, b: PlacedFrame, ground_z_m: float) -> float:
    """How far the ground moves and turns from one picture to another, as a share of the field of view."""
    (p, q), lens = (a.camera, b.camera), a.camera.lens
    if b.camera.lens.width != lens.width or b.camera.lens.height != lens.height:
        return float("inf")
    moved = np.linalg.norm(q.position - p.position) / max(float(p.position[2]) - ground_z_m, 1.0)
    turned = np.arccos(np.clip(0.5 * (float(np.tensordot(p.rotation, q.rotation)) - 1.0), -1.0, 1.0))
    return float((moved + turned) / fov_rad(lens.focal_px, min(lens.width, lens.height)))
