"""Whether recorded heights agree with the pictures: what the adjustment would say of them if they were not believed.

Over flat ground seen straight down only f / h is observable, and a wrong height makes a wrong focal length unseen. But
aircraft sway, and legs cross: how far the picture moves with the recorded attitude tells f by itself, and with it h
(measured: heights 30 % off are found to some per cent, by 20 pictures as by 300).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.refine.bundle.adjustment import Adjustment

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FREE_SIGMA_M = 30.0
"""One sigma of the common height offset where the record tells nothing."""
_SIGMAS = 4.0
_SHARE = 0.15
"""Less than this, of the height: the distortion and the centre of real lenses, as far as they are not modelled, say so
too (measured: 10 % on a lens of k1 = -0.4 seen straight down)."""
_AGREES_SIGMAS = 2.0


def offsets_without_height_prior(adjustment: Adjustment) -> tuple[Array, Array]:
    """Offsets of the recorded heights by the pictures alone, after a step: metres and one sigma, float64 (G,) both.

    The reduced normal equations of the common unknowns without the belief in the heights give, with that belief P
    and at its optimum x, the optimum without it: x + (N - P)^-1 P x.
    """
    layout, models = adjustment.layout, adjustment.priors.models
    at = np.array([o + 3 for o in layout.offset])
    believed = np.array([1.0 / max(m.height_sigma, 1e-9) ** 2 for m in models])
    less = np.maximum(believed - FREE_SIGMA_M**-2, 0.0)
    without = adjustment.information.copy()
    without[at, at] -= less
    pull = np.zeros(layout.size)
    pull[at] = less * adjustment.common[at]
    inverse = np.linalg.inv(without)
    offset = adjustment.common + inverse @ pull
    return np.asarray(offset[at]), np.sqrt(np.maximum(np.diag(inverse)[at], 0.0))


def contradicted_heights(adjustment: Adjustment) -> Flags:
    """Groups whose recorded heights the pictures contradict beyond doubt, bool (G,)."""
    sigma = np.array([m.height_sigma for m in adjustment.priors.models])
    if (sigma >= FREE_SIGMA_M).all() or not adjustment.information.size:
        return np.zeros(len(sigma), bool)
    offset, doubt = offsets_without_height_prior(adjustment)
    total = np.hypot(doubt, sigma)
    far = np.abs(offset) > np.maximum(_SIGMAS * total, _SHARE * _height(adjustment))
    return np.asarray(far & (sigma < FREE_SIGMA_M), np.bool_)


def release_heights(adjustment: Adjustment) -> Flags:
    """Stop believing the heights that the pictures contradict; some more steps are due where there are any.

    Returns:
        bool (G,), groups whose heights were believed until now.
    """
    wrong = contradicted_heights(adjustment)
    if wrong.any():
        p = adjustment.priors
        models = [replace(m, height_sigma=FREE_SIGMA_M) if w else m for m, w in zip(p.models, wrong, strict=True)]
        adjustment.priors = replace(p, models=tuple(models))
    return wrong


def height_disagreement(adjustment: Adjustment) -> float:
    """How far heights that are believed disagree with the pictures, as a share of the height; 0 where they agree."""
    sigma = np.array([m.height_sigma for m in adjustment.priors.models])
    believed = sigma < FREE_SIGMA_M
    if not believed.any() or not adjustment.information.size:
        return 0.0
    offset, doubt = offsets_without_height_prior(adjustment)
    beyond = np.abs(offset) - _AGREES_SIGMAS * np.hypot(doubt, sigma)
    return float(np.maximum(beyond[believed], 0.0).max()) / _height(adjustment)


def log_focal_sigmas(adjustment: Adjustment) -> Array:
    """One sigma of the log of each lens's focal length at the last step, float64 (L,); infinite before one."""
    if not adjustment.information.size:
        return np.full(len(adjustment.cameras.lens), np.inf)
    variance = np.diag(np.linalg.inv(adjustment.information))[: adjustment.layout.lens_columns : 6]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _height(adjustment: Adjustment) -> float:
    ground = float(np.median(adjustment.points[:, 2])) if len(adjustment.points) else 0.0
    return max(float(np.median(adjustment.cameras.position[:, 2])) - ground, 1.0)
