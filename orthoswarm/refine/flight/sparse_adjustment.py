"""The relative adjustment of sparse photos: the same unknowns as for tracked flights, in a different order.

On flat ground seen straight down, focal length and heights can scale together; a prior on every point's height would
then pull the cameras down. So level ground is assumed in the first stage only; later the median of the points
alone is fixed at the takeoff level.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.robust import mad_sigma, mad_sigmas
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior
from orthoswarm.refine.bundle.block_arrays import K1, WIDTH, F, Tracks
from orthoswarm.refine.bundle.height_consistency import release_heights
from orthoswarm.refine.bundle.prior_equations import bias_axes
from orthoswarm.refine.bundle.priors import GroupPriors, Priors
from orthoswarm.refine.bundle.rotation_vectors import log_rotation
from orthoswarm.refine.flight.relative_block import first_points
from orthoswarm.refine.flight.sparse_start import SparseStart
from orthoswarm.refine.initial.planar_similarity import Array

NO_PRIOR_SIGMA_M = 1e6
"""A sigma that makes a prior's weight vanish, metres."""
MEDIAN_LENGTH_SIGMAS = 1.1774
"""Median length of a Gaussian residual of two axes, in sigmas of an axis: sqrt(2 ln 2)."""


def solve_sparse(start: SparseStart) -> Adjustment:
    """Adjust cameras, lenses and points without a map.

    Args:
        start: from `sparse_start`.

    Returns:
        The adjustment, with its observations' sigmas scaled to the residuals and its attitude priors to their scatter.
    """
    config = active().flight
    schedule = tuple(zip(config.sparse_stage_c, config.sparse_stage_steps, strict=True))
    cameras, tracks = start.cameras, start.tracks
    adjustment = Adjustment.begin(cameras, tracks, _priors(start), first_points(cameras, tracks))
    for k, (c, steps) in enumerate(schedule):  # the first stage fixes the lens and assumes level ground
        if k == 1:
            _free_lens(adjustment, start, full=False)
        if k >= 2:
            _widen_position_sigmas(adjustment)
        if k == len(schedule) - 1:  # k3 and principal point, too, of lenses with enough observations
            _attitude_sigmas_from_residuals(adjustment)
            _free_lens(adjustment, start, full=True)
        for _ in range(steps):
            ground = plane_prior(adjustment) if k == 0 else datum_prior(adjustment)
            damping = config.sparse_first_damping if k == 0 else config.sparse_damping
            move = adjustment.step(c, ground, damping=damping)
            if move < _converged_m(adjustment):
                break
        _rescale_sigmas(adjustment)
    if release_heights(adjustment).any():
        c, steps = schedule[-1]
        for _ in range(steps):
            if adjustment.step(c, datum_prior(adjustment)) < _converged_m(adjustment):
                break
    return adjustment


def trusted_heights(adjustment: Adjustment, start: SparseStart) -> NDArray[np.bool_]:
    """Photos whose recorded heights the final adjustment used, bool (N,)."""
    p = adjustment.priors
    sigma = np.array([model.height_sigma for model in p.models])
    return np.asarray(start.height_known & (sigma < active().bundle.unknown_height_sigma_m)[p.group])


def _converged_m(adjustment: Adjustment) -> float:
    """Convergence limit: the largest camera movement of the last step, metres."""
    return active().flight.sparse_converged_share * float(np.median(np.abs(adjustment.cameras.position[:, 2])))


def plane_prior(adjustment: Adjustment) -> HeightPrior:
    """A height prior for all points at 0."""
    c = active().flight
    zero = np.zeros(len(adjustment.points))
    return HeightPrior(zero, c.sparse_plane_sigma_m, c.sparse_plane_soft_sigma_m, c=c.sparse_plane_c)


def datum_prior(adjustment: Adjustment, level_m: float = 0.0) -> HeightPrior:
    """A prior for the median height of all points that does not constrain their scatter.

    Each point's prior asks for the shift of the median; together they weigh as much as one observation.
    """
    z = adjustment.points[:, 2]
    middle = float(np.median(z)) if len(z) else 0.0
    soft = active().flight.sparse_datum_sigma_m * float(np.sqrt(max(len(z), 1)))
    return HeightPrior(z - middle + level_m, NO_PRIOR_SIGMA_M, soft)


def _priors(start: SparseStart) -> Priors:
    c = active().flight
    n, lenses = len(start.cameras), len(start.cameras.lens)
    lens = np.zeros((lenses, 6))
    lens[:, 0], lens[:, 1] = np.log(start.cameras.lens[:, F]), start.cameras.lens[:, K1]
    held = np.tile([c.sparse_held_lens_sigma, c.sparse_held_lens_sigma, 0.0, 0.0, 0.0, 0.0], (lenses, 1))
    return Priors(
        position=start.position_prior,
        position_sigma=start.position_sigma,
        rotation=start.cameras.rotation.copy(),
        rotation_sigma=np.full((n, 3), np.radians(c.sparse_first_attitude_sigma_deg)),
        velocity=start.velocity,
        group=start.segment,
        models=_models(start),
        lens=lens,
        lens_sigma=held,
    )


def _models(start: SparseStart) -> tuple[GroupPriors, ...]:
    c = active().flight
    bx, by, bz = np.radians(c.sparse_bias_sigma_deg).tolist()
    models = []
    for s in range(int(start.segment.max()) + 1):
        rows = start.segment == s
        stated = np.isfinite(start.records.position_sigma[rows]).mean() > 0.5
        usual = active().bundle
        offset = c.sparse_stated_offset_sigma_m if stated else usual.height_offset_sigma_m
        models.append(
            GroupPriors(
                bias_sigma=(bx, by, bz),
                height_sigma=offset if start.height_known[rows].mean() > 0.5 else usual.unknown_height_sigma_m,
                lag_sigma=c.sparse_stated_lag_sigma_s if stated else active().records.lag_sigma_s,
                drift_sigma=0.0 if stated else c.sparse_drift_sigma_m,
                drift_bend=c.sparse_drift_bend_m,
                knot_every=c.sparse_drift_knot_photos,
            )
        )
    return tuple(models)


def _free_lens(adjustment: Adjustment, start: SparseStart, *, full: bool) -> None:
    """Lens priors: the focal length from the tags, no distortion."""
    c = active().flight
    p = adjustment.priors
    lenses = len(start.cameras.lens)
    seen = np.bincount(start.cameras.lens_id[adjustment.tracks.camera], minlength=lenses)
    photos = np.bincount(start.cameras.lens_id, minlength=lenses)
    rich = (seen >= c.sparse_full_lens_observations) & (photos >= c.sparse_full_lens_photos) & full
    width = start.cameras.lens[:, WIDTH]
    lens = np.zeros((lenses, 6))
    lens[:, 0] = start.log_focal
    sigma = np.zeros((lenses, 6))
    sigma[:, 0], sigma[:, 1], sigma[:, 2] = start.log_focal_sigma, *c.sparse_lens_sigma
    sigma[rich, 1:4] = c.sparse_full_lens_sigma
    sigma[rich, 4] = sigma[rich, 5] = c.principal_point_share * width[rich]
    now = p.lens + adjustment.common[: 6 * lenses].reshape(-1, 6)
    adjustment.common[: 6 * lenses] = (now - lens).ravel()
    adjustment.priors = replace(p, lens=lens, lens_sigma=sigma)


def _widen_position_sigmas(adjustment: Adjustment) -> None:
    """Widen the sigmas of positions and heights that scatter more than stated.

    Too small height sigmas push the cameras up, where height errors cost less.
    """
    p = adjustment.priors
    off = adjustment.position_residuals() / np.maximum(p.position_sigma, 1e-9)
    horizontal = mad_sigma(off[:, :2])
    scatter = np.array([horizontal, horizontal, mad_sigma(off[:, 2])])
    adjustment.priors = replace(p, position_sigma=p.position_sigma * np.maximum(scatter, 1.0))


def _attitude_sigmas_from_residuals(adjustment: Adjustment) -> None:
    """Set the sigmas of the attitude priors to the scatter of adjusted attitudes about them."""
    c = active().flight
    p = adjustment.priors
    sigma = p.rotation_sigma.copy()
    for g in range(len(p.models)):
        rows = np.flatnonzero(p.group == g)
        bias = bias_axes(p.rotation[rows]) @ adjustment.group_values(g)[0]
        off = log_rotation(np.swapaxes(p.rotation[rows], 1, 2) @ adjustment.cameras.rotation[rows]) - bias
        scatter = mad_sigmas(off)
        sigma[rows] = np.clip(c.sparse_attitude_scatters * scatter, *np.radians(c.sparse_attitude_range_deg))
    adjustment.priors = replace(p, rotation_sigma=sigma)


def _rescale_sigmas(adjustment: Adjustment) -> None:
    """Scale the sigmas of all observations so that the median residual matches the redundancy."""
    c = active().flight
    tracks = adjustment.tracks
    residual = adjustment.residuals()
    off = np.hypot(residual[:, 0], residual[:, 1]) / tracks.sigma_px
    seen = off[np.isfinite(off)]
    if len(seen) < c.sparse_scaled_observations:
        return
    unknowns = 3 * len(adjustment.points) + 6 * len(adjustment.cameras)
    freedom = max(1.0 - unknowns / (2.0 * len(off)), c.sparse_least_freedom)
    scale = float(np.median(seen)) / (MEDIAN_LENGTH_SIGMAS * np.sqrt(freedom))
    sigma = np.maximum(tracks.sigma_px * np.float32(scale), np.float32(c.sparse_least_sigma_px))
    adjustment.tracks = Tracks(tracks.camera, tracks.point, tracks.uv, sigma.astype(np.float32))


def heights_above_ground(adjustment: Adjustment) -> Array:
    """Height of each camera over the median of the points, float64 (N,)."""
    level = float(np.median(adjustment.points[:, 2])) if len(adjustment.points) else 0.0
    return np.asarray(adjustment.cameras.position[:, 2] - level)
