"""The relative adjustment of sparse photos: the same unknowns as for dense flights, another schedule.

A plane as a prior on every point would pull the cameras down on flat ground seen straight from above, where focal
length and heights scale together unseen; so the plane serves only to begin with, then the median of the points alone
is held, at the takeoff level.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior
from orthoswarm.refine.bundle.block_arrays import K1, WIDTH, F, Tracks
from orthoswarm.refine.bundle.height_consistency import release_heights
from orthoswarm.refine.bundle.priors import GroupPriors, Priors
from orthoswarm.refine.bundle.rotation_vectors import log_rotation
from orthoswarm.refine.flight.relative_block import first_points
from orthoswarm.refine.flight.sparse_start import SparseStart
from orthoswarm.refine.initial.planar_similarity import Array

_DATUM_SIGMA_M = 3.0
_PLANE_SIGMA_M = 3.0
_DRIFT_SIGMA_M = 4.0
_DRIFT_BEND_M = 2.5
_PHOTOS_PER_KNOT = 12
_HELD = 0.02
_LENS_SIGMA = (0.1, 0.05)
_FULL_LENS_SIGMA = (0.2, 0.2, 0.3, 0.012)
"""k1, k2, k3, and the principal point as a share of the picture's width. A tight k2 bends the focal length of a lens
that distorts strongly, as distortion goes with powers of it."""
_FULL_LENS_OBSERVATIONS = 800
_BIAS_SIGMA = (float(np.radians(15.0)), float(np.radians(15.0)), float(np.radians(5.0)))
_FIRST_ATTITUDE_SIGMA = float(np.radians(3.0))
_ATTITUDE_RANGE = (float(np.radians(1.0)), float(np.radians(3.0)))
"""Tighter priors on attitudes that came from the pictures bend the focal length on flat ground (measured: 20 degrees of
FoV at 0.1 degrees, none from 1 degree on)."""
_SCATTERS = 2.0
_SMALLEST_SIGMA_PX = 0.05


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage of the schedule: robust scale, most steps, and whether it ends as soon as the cameras stand still."""

    c: float
    steps: int


SCHEDULE: tuple[Stage, ...] = (Stage(1e4, 4), Stage(400.0, 4), Stage(50.0, 5), Stage(9.0, 10))


def solve_sparse(start: SparseStart, *, full_lens: bool = True, schedule: Sequence[Stage] = SCHEDULE) -> Adjustment:
    """Adjust cameras, lenses and points without a map.

    Args:
        start: from `sparse_start`.
        full_lens: also estimate k3 and the principal point in the last stage, of lenses with enough observations.
        schedule: stages; the first holds the lens and the ground's plane, the last frees the full lens.

    Returns:
        The adjustment, its observations' sigmas scaled to what is left of them, its attitude priors to their scatter.
    """
    cameras, tracks = start.cameras, start.tracks
    adjustment = Adjustment.begin(cameras, tracks, _priors(start), first_points(cameras, tracks))
    for k, stage in enumerate(schedule):
        if k == 1:
            _free_lens(adjustment, start, full=False)
        if k >= 2:
            _widen_position_sigmas(adjustment)
        if k == len(schedule) - 1:
            _attitude_sigmas_from_residuals(adjustment)
            _free_lens(adjustment, start, full=full_lens)
        for _ in range(stage.steps):
            ground = plane_prior(adjustment) if k == 0 else datum_prior(adjustment)
            move = adjustment.step(stage.c, ground, damping=1e-4 if k == 0 else 1e-6)
            if move < _converged_m(adjustment):
                break
        _rescale_sigmas(adjustment)
    if release_heights(adjustment).any():
        for _ in range(schedule[-1].steps):
            if adjustment.step(schedule[-1].c, datum_prior(adjustment)) < _converged_m(adjustment):
                break
    return adjustment


def trusted_heights(adjustment: Adjustment, start: SparseStart) -> NDArray[np.bool_]:
    """Photos whose recorded heights were believed to the end, bool (N,)."""
    p = adjustment.priors
    sigma = np.array([model.height_sigma for model in p.models])
    return np.asarray(start.height_known & (sigma < active().bundle.unknown_height_sigma_m)[p.group])


def _converged_m(adjustment: Adjustment) -> float:
    """A step that moves no camera farther than this is the last one."""
    return 2e-4 * float(np.median(np.abs(adjustment.cameras.position[:, 2])))


def plane_prior(adjustment: Adjustment) -> HeightPrior:
    """Belief that all points lie near height 0."""
    zero = np.zeros(len(adjustment.points))
    return HeightPrior(zero, _PLANE_SIGMA_M, 20.0, c=1e3)


def datum_prior(adjustment: Adjustment, level_m: float = 0.0, sigma_m: float = _DATUM_SIGMA_M) -> HeightPrior:
    """Belief that the median of all points lies at a height; it says nothing of how they scatter about it.

    Each point is asked to move as the median must, all of them together with the weight of one observation.
    """
    z = adjustment.points[:, 2]
    middle = float(np.median(z)) if len(z) else 0.0
    soft = sigma_m * float(np.sqrt(max(len(z), 1)))
    return HeightPrior(z - middle + level_m, 1e6, soft)


def _priors(start: SparseStart) -> Priors:
    n, lenses = len(start.cameras), len(start.cameras.lens)
    lens = np.zeros((lenses, 6))
    lens[:, 0], lens[:, 1] = np.log(start.cameras.lens[:, F]), start.cameras.lens[:, K1]
    held = np.tile([_HELD, _HELD, 0.0, 0.0, 0.0, 0.0], (lenses, 1))
    return Priors(
        position=start.position_prior,
        position_sigma=start.position_sigma,
        rotation=start.cameras.rotation.copy(),
        rotation_sigma=np.full((n, 3), _FIRST_ATTITUDE_SIGMA),
        velocity=start.velocity,
        group=start.segment,
        models=_models(start),
        lens=lens,
        lens_sigma=held,
    )


def _models(start: SparseStart) -> tuple[GroupPriors, ...]:
    models = []
    for s in range(int(start.segment.max()) + 1):
        rows = start.segment == s
        stated = np.isfinite(start.records.position_sigma[rows]).mean() > 0.5
        models.append(
            GroupPriors(
                bias_sigma=_BIAS_SIGMA,
                height_sigma=(0.1 if stated else 1.0)
                if start.height_known[rows].mean() > 0.5
                else active().bundle.unknown_height_sigma_m,
                lag_sigma=0.2 if stated else 0.5,
                drift_sigma=0.0 if stated else _DRIFT_SIGMA_M,
                drift_bend=_DRIFT_BEND_M,
                knot_every=_PHOTOS_PER_KNOT,
            )
        )
    return tuple(models)


def _free_lens(adjustment: Adjustment, start: SparseStart, *, full: bool) -> None:
    """Priors of the lens about what tags say of the focal length and about no distortion."""
    p = adjustment.priors
    lenses = len(start.cameras.lens)
    seen = np.bincount(start.cameras.lens_id[adjustment.tracks.camera], minlength=lenses)
    photos = np.bincount(start.cameras.lens_id, minlength=lenses)
    rich = (seen >= _FULL_LENS_OBSERVATIONS) & (photos >= 8) & full
    width = start.cameras.lens[:, WIDTH]
    lens = np.zeros((lenses, 6))
    lens[:, 0] = start.log_focal
    sigma = np.zeros((lenses, 6))
    sigma[:, 0], sigma[:, 1], sigma[:, 2] = start.log_focal_sigma, *_LENS_SIGMA
    sigma[rich, 1:4] = _FULL_LENS_SIGMA[:3]
    sigma[rich, 4] = sigma[rich, 5] = _FULL_LENS_SIGMA[3] * width[rich]
    now = p.lens + adjustment.common[: 6 * lenses].reshape(-1, 6)
    adjustment.common[: 6 * lenses] = (now - lens).ravel()
    adjustment.priors = replace(p, lens=lens, lens_sigma=sigma)


def _widen_position_sigmas(adjustment: Adjustment) -> None:
    """Larger sigmas for positions and heights that scatter more than theirs say.

    Heights that are worse than they are believed to be push the cameras up, where they matter less.
    """
    p = adjustment.priors
    off = np.abs(adjustment.position_residuals()) / np.maximum(p.position_sigma, 1e-9)
    scatter = 1.4826 * np.array([np.median(off[:, :2]), np.median(off[:, :2]), np.median(off[:, 2])])
    adjustment.priors = replace(p, position_sigma=p.position_sigma * np.maximum(scatter, 1.0))


def _attitude_sigmas_from_residuals(adjustment: Adjustment) -> None:
    """Sigmas of the attitude priors from how adjusted attitudes scatter about them."""
    p = adjustment.priors
    sigma = p.rotation_sigma.copy()
    for g in range(len(p.models)):
        rows = np.flatnonzero(p.group == g)
        bias = adjustment.group_values(g)[0]
        off = log_rotation(np.swapaxes(p.rotation[rows], 1, 2) @ adjustment.cameras.rotation[rows]) - bias
        scatter = 1.4826 * np.median(np.abs(off), axis=0)
        sigma[rows] = np.clip(_SCATTERS * scatter, *_ATTITUDE_RANGE)
    adjustment.priors = replace(p, rotation_sigma=sigma)


def _rescale_sigmas(adjustment: Adjustment) -> None:
    """Scale all observations' sigmas so that their residuals are as large as they should be."""
    tracks = adjustment.tracks
    residual = adjustment.residuals()
    off = np.hypot(residual[:, 0], residual[:, 1]) / tracks.sigma_px
    seen = off[np.isfinite(off)]
    if len(seen) < 20:
        return
    unknowns = 3 * len(adjustment.points) + 6 * len(adjustment.cameras)
    freedom = max(1.0 - unknowns / (2.0 * len(off)), 0.2)
    scale = float(np.median(seen)) / (1.1774 * np.sqrt(freedom))
    sigma = np.maximum(tracks.sigma_px * np.float32(scale), np.float32(_SMALLEST_SIGMA_PX))
    adjustment.tracks = Tracks(tracks.camera, tracks.point, tracks.uv, sigma.astype(np.float32))


def heights_above_ground(adjustment: Adjustment) -> Array:
    """Height of each camera over the median of the points, float64 (N,)."""
    level = float(np.median(adjustment.points[:, 2])) if len(adjustment.points) else 0.0
    return np.asarray(adjustment.cameras.position[:, 2] - level)
