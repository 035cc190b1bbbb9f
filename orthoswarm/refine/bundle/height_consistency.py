"""Check of recorded heights against the pictures: the height offset that the adjustment finds without their prior.

Over flat ground and straight down only f / h is observable, so a wrong height gives a wrong focal length. But
aircraft sway, and legs cross: the picture's movement with the recorded attitude gives f alone, and so h
(measured: heights that are 30 % off are recovered to a few per cent, from 20 pictures as from 300).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags
from orthoswarm.refine.bundle.adjustment import Adjustment

UNKNOWN_HEIGHT_SIGMA_M: Final = 30.0
"""Sigma of a sortie's common height offset where no height was recorded or it is not trusted."""
_AT_REST_SHARE: Final = 0.03  # a focal length that still moves by this share in three steps is not at rest
_CONTRADICTION_SIGMAS: Final = 4.0  # a recorded height is contradicted by an offset of so many of its sigmas ...
_CONTRADICTION_SHARE: Final = 0.15
"""... and this share of the height: distortion and principal point of real lenses, as far as they are not modelled,
also look like a wrong height (measured: 10 % on a lens of k1 = -0.4 that looks straight down)."""
_AGREEMENT_SIGMAS: Final = 2.0  # what an offset exceeds so many sigmas by enters the sigma of the field of view
_AGREEING_SHARE: Final = 0.08  # pictures that come to rest within this share of the recorded height agree with it


def offsets_without_height_prior(adjustment: Adjustment) -> tuple[Array, Array]:
    """Offsets of the recorded heights according to the pictures alone, metres, and their sigmas; both float64 (G,).

    With N the reduced normal matrix of the common unknowns, P the height prior's part of it and x the optimum, the
    optimum without the prior is x + (N - P)^-1 P x.
    """
    layout, models = adjustment.layout, adjustment.priors.models
    at = np.array([o + 3 for o in layout.offset])
    prior = np.array([1.0 / max(m.height_sigma, 1e-9) ** 2 for m in models])
    less = np.maximum(prior - UNKNOWN_HEIGHT_SIGMA_M**-2, 0.0)
    without = adjustment.information.copy()
    without[at, at] -= less
    pull = np.zeros(layout.size)
    pull[at] = less * adjustment.common[at]
    inverse = np.linalg.inv(without)
    offset = adjustment.common + inverse @ pull
    return np.asarray(offset[at]), np.sqrt(np.maximum(np.diag(inverse)[at], 0.0))


def contradicted_heights(adjustment: Adjustment) -> Flags:
    """Groups whose recorded heights the pictures contradict significantly, bool (G,)."""
    sigma = np.array([m.height_sigma for m in adjustment.priors.models])
    if (sigma >= UNKNOWN_HEIGHT_SIGMA_M).all() or not adjustment.information.size:
        return np.zeros(len(sigma), bool)
    offset, offset_sigma = offsets_without_height_prior(adjustment)
    total = np.hypot(offset_sigma, sigma)
    limit = np.maximum(_CONTRADICTION_SIGMAS * total, _CONTRADICTION_SHARE * _height(adjustment))
    return np.asarray((np.abs(offset) > limit) & (sigma < UNKNOWN_HEIGHT_SIGMA_M), np.bool_)


def predicted_height_offset(adjustment: Adjustment) -> tuple[float, float]:
    """Offset of the recorded heights that an adjustment without their prior should come to, and its tolerance, metres.

    Median of the groups; the tolerance is the limit beyond which an offset contradicts the record. A result farther off
    is no solution of the normal equations that predicted it: the pictures determine no height.
    """
    offset, sigma = offsets_without_height_prior(adjustment)
    tolerance = max(_CONTRADICTION_SIGMAS * float(np.median(sigma)), _CONTRADICTION_SHARE * _height(adjustment))
    return float(np.median(offset)), tolerance


def release_heights(adjustment: Adjustment) -> Flags:
    """Loosen the prior on heights that the pictures contradict; bool (G,), the groups where it did."""
    wrong = contradicted_heights(adjustment)
    if wrong.any():
        p = adjustment.priors
        known = zip(p.models, wrong, strict=True)
        models = tuple(replace(m, height_sigma=UNKNOWN_HEIGHT_SIGMA_M) if w else m for m, w in known)
        adjustment.priors = replace(p, models=models)
    return wrong


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeHeight:
    """What the adjustment of one vehicle came to without its recorded heights.

    focal_px: focal length after each of the last steps. recorded_m: median recorded height above the takeoff point.
    solved_m: median height above the solved ground. predicted: difference of the two that `predicted_height_offset`
    expected, and its tolerance, metres.
    """

    focal_px: Sequence[float]
    recorded_m: float
    solved_m: float
    predicted: tuple[float, float]

    @property
    def converged(self) -> bool:
        """Whether the focal length has stopped changing."""
        return bool(np.ptp(np.log(self.focal_px[-3:])) < _AT_REST_SHARE)

    @property
    def refutes_record(self) -> bool:
        """Whether it shows that the recorded heights are wrong.

        It must have converged, near the height that the normal equations predicted, and away from the recorded one: few
        pictures of a levelled camera over flat ground hardly determine the focal length, which then drifts to another
        minimum.
        """
        offset_m, (predicted_m, tolerance_m) = self.solved_m - self.recorded_m, self.predicted
        agrees = abs(offset_m) < _AGREEING_SHARE * self.recorded_m
        return self.converged and abs(offset_m - predicted_m) <= tolerance_m and not agrees


def height_disagreement(adjustment: Adjustment) -> float:
    """Significant difference of recorded heights that have a prior from the pictures, as a share of the height."""
    sigma = np.array([m.height_sigma for m in adjustment.priors.models])
    known = sigma < UNKNOWN_HEIGHT_SIGMA_M
    if not known.any() or not adjustment.information.size:
        return 0.0
    offset, offset_sigma = offsets_without_height_prior(adjustment)
    beyond = np.abs(offset) - _AGREEMENT_SIGMAS * np.hypot(offset_sigma, sigma)
    return float(np.maximum(beyond[known], 0.0).max()) / _height(adjustment)


def log_focal_sigmas(adjustment: Adjustment) -> Array:
    """One sigma of the log of each lens's focal length at the last step, float64 (L,); infinite before one."""
    if not adjustment.information.size:
        return np.full(len(adjustment.cameras.lens), np.inf)
    variance = np.diag(np.linalg.inv(adjustment.information))[: adjustment.layout.lens_columns : 6]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _height(adjustment: Adjustment) -> float:
    return max(float(np.median(adjustment.cameras.position[:, 2])) - adjustment.ground_m, 1.0)
