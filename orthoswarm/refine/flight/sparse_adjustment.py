"""The relative adjustment of sparse photos: the same unknowns as for tracked flights, in a different order.

On flat ground seen straight down, focal length and heights can scale together; a prior on every point's height would
then pull the cameras down. So level ground is assumed in the first stage only; later the median of the points
alone is fixed at the takeoff level.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Flags
from orthoswarm.model.robust import MEDIAN_LENGTH_SIGMAS, mad_sigma, mad_sigmas
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior
from orthoswarm.refine.bundle.block_arrays import K1, WIDTH, F, log_rotation
from orthoswarm.refine.bundle.height_consistency import UNKNOWN_HEIGHT_SIGMA_M, release_heights
from orthoswarm.refine.bundle.priors import HEIGHT_OFFSET_SIGMA_M, LAG_SIGMA_S, GroupPriors, Priors, bias_axes
from orthoswarm.refine.flight.relative_block import PRINCIPAL_POINT_SHARE, first_points
from orthoswarm.refine.flight.sparse_start import SparseStart

NO_PRIOR_SIGMA_M = 1e6  # a sigma that makes a prior's weight vanish, metres
_SPARSE_STATED_OFFSET_SIGMA_M: Final = 0.1  # common offset of heights where positions state sigmas
_SPARSE_STATED_LAG_SIGMA_S: Final = 0.2  # sigma of the lag of recorded positions where they state their sigmas
_SPARSE_BIAS_SIGMA_DEG: Final = (15.0, 15.0, 5.0)
"""Sigma of a sortie's attitude bias about the camera's x, y, z axes: tags of tilted cameras may lack the tilt (a camera
tilted by 15 degrees without tags was found)."""
_SPARSE_DRIFT_SIGMA_M: Final = 4.0  # sigma of the receiver's drift
_SPARSE_DRIFT_BEND_M: Final = 2.5  # sigma of the second difference of the drift's knots
_SPARSE_DRIFT_KNOT_PHOTOS: Final = 12  # photos between two knots of the drift
SPARSE_STAGE_C: Final = (1e4, 400.0, 50.0, 9.0)  # robust scale c of each stage, squared sigmas: graduated non-convexity
_SPARSE_STAGE_STEPS: Final = (4, 4, 5, 10)  # most steps of each stage
_SPARSE_FIRST_DAMPING: Final = 1e-4  # damping of the steps of the first stage
_SPARSE_DAMPING: Final = 1e-6  # damping of the steps of later stages
_SPARSE_CONVERGED_SHARE: Final = 2e-4  # a step that moves no camera by more, in heights, ends its stage
_SPARSE_PLANE_SIGMA_M: Final = 3.0
"""Sigma of all points about level ground in the first stage. Later a plane would pull the cameras down on flat ground
seen straight down, where focal length and heights scale together unseen."""
_SPARSE_PLANE_SOFT_SIGMA_M: Final = 20.0  # sigma of the weak prior beside it that is not robust
_SPARSE_PLANE_C: Final = 1e3  # robust scale c of that plane, squared sigmas
_SPARSE_DATUM_SIGMA_M: Final = 3.0  # sigma of the median of all points about the takeoff level
_SPARSE_HELD_LENS_SIGMA: Final = 0.02  # sigma of log f and k1 in the first stage
_SPARSE_LENS_SIGMA: Final = (0.1, 0.05)  # sigma of k1 and k2
_SPARSE_FULL_LENS_SIGMA: Final = (0.2, 0.2, 0.3)
"""Sigma of k1, k2, k3 of a lens solved in full: a tight k2 bends the focal length of a lens that distorts strongly, as
distortion goes with powers of it."""
_SPARSE_FULL_LENS_OBSERVATIONS: Final = 800  # least observations of a lens that is solved in full
_SPARSE_FULL_LENS_PHOTOS: Final = 8  # least photos of such a lens
_SPARSE_FIRST_ATTITUDE_SIGMA_DEG: Final = 3.0  # sigma of attitudes from the pairs until the last stage
_SPARSE_ATTITUDE_RANGE_DEG: Final = (1.0, 3.0)
"""Range of their sigma in the last stage. Tighter ones bend the focal length on flat ground (measured: 20 degrees of
field of view at 0.1 degrees, none from 1 degree on)."""
_SPARSE_ATTITUDE_SCATTERS: Final = 2.0  # ... within which it is so many times their scatter
_SPARSE_LEAST_SIGMA_PX: Final = 0.05  # least sigma of an observation after the sigmas are scaled to the residuals
_SPARSE_SCALED_OBSERVATIONS: Final = 20  # with fewer observations the sigmas are not scaled
_SPARSE_LEAST_FREEDOM: Final = 0.2  # least redundancy in that scaling, observations beyond unknowns


def solve_sparse(start: SparseStart) -> Adjustment:
    """Adjust cameras, lenses and points without a map; observations and attitudes get the sigmas of residuals."""
    schedule = tuple(zip(SPARSE_STAGE_C, _SPARSE_STAGE_STEPS, strict=True))
    points = first_points(start.cameras, start.tracks)
    adjustment = Adjustment.begin(start.cameras, start.tracks, _priors(start), points)
    plane = HeightPrior(np.zeros(len(points)), _SPARSE_PLANE_SIGMA_M, _SPARSE_PLANE_SOFT_SIGMA_M, c=_SPARSE_PLANE_C)
    for k, (c, steps) in enumerate(schedule):  # the first stage fixes the lens and assumes level ground
        if k == 1:
            _free_lens(adjustment, start, full=False)
        if k >= 2:  # positions and heights that scatter more than stated: too small sigmas push the cameras up
            p = adjustment.priors
            off = adjustment.position_residuals() / np.maximum(p.position_sigma, 1e-9)
            across, up = max(mad_sigma(off[:, :2]), 1.0), max(mad_sigma(off[:, 2]), 1.0)
            adjustment.priors = replace(p, position_sigma=p.position_sigma * [across, across, up])
        if k == len(schedule) - 1:  # k3 and principal point, too, of lenses with enough observations
            _attitude_sigmas_from_residuals(adjustment)
            _free_lens(adjustment, start, full=True)
        for _ in range(steps):
            ground = plane if k == 0 else datum_prior(adjustment)
            damping = _SPARSE_FIRST_DAMPING if k == 0 else _SPARSE_DAMPING
            move = adjustment.step(c, ground, damping=damping)
            if move < _converged_m(adjustment):
                break
        _rescale_sigmas(adjustment)
    if release_heights(adjustment).any():
        for _ in range(_SPARSE_STAGE_STEPS[-1]):
            if adjustment.step(SPARSE_STAGE_C[-1], datum_prior(adjustment)) < _converged_m(adjustment):
                break
    return adjustment


def trusted_heights(adjustment: Adjustment, start: SparseStart) -> Flags:
    """Photos whose recorded heights the final adjustment used, bool (N,)."""
    p = adjustment.priors
    sigma = np.array([model.height_sigma for model in p.models])
    return np.asarray(start.height_known & (sigma < UNKNOWN_HEIGHT_SIGMA_M)[p.group])


def _converged_m(adjustment: Adjustment) -> float:
    """Convergence limit: the largest camera movement of the last step, metres."""
    return _SPARSE_CONVERGED_SHARE * float(np.median(np.abs(adjustment.cameras.position[:, 2])))


def datum_prior(adjustment: Adjustment, level_m: float = 0.0) -> HeightPrior:
    """A prior that asks the median height of all points to be level_m, as one observation; their scatter stays free."""
    z = adjustment.points[:, 2]
    soft = _SPARSE_DATUM_SIGMA_M * float(np.sqrt(max(len(z), 1)))
    return HeightPrior(z - adjustment.ground_m + level_m, NO_PRIOR_SIGMA_M, soft)


def _priors(start: SparseStart) -> Priors:
    n, lenses = len(start.cameras), len(start.cameras.lens)
    lens = np.zeros((lenses, 6))
    lens[:, 0], lens[:, 1] = np.log(start.cameras.lens[:, F]), start.cameras.lens[:, K1]
    held = np.tile([_SPARSE_HELD_LENS_SIGMA, _SPARSE_HELD_LENS_SIGMA, 0.0, 0.0, 0.0, 0.0], (lenses, 1))
    bx, by, bz = np.radians(_SPARSE_BIAS_SIGMA_DEG).tolist()
    models = []
    for s in range(int(start.records.segment.max()) + 1):
        rows = start.records.segment == s
        stated = np.isfinite(start.records.position_sigma[rows]).mean() > 0.5
        offset = _SPARSE_STATED_OFFSET_SIGMA_M if stated else HEIGHT_OFFSET_SIGMA_M
        models.append(
            GroupPriors(
                bias_sigma=(bx, by, bz),
                height_sigma=offset if start.height_known[rows].mean() > 0.5 else UNKNOWN_HEIGHT_SIGMA_M,
                lag_sigma=_SPARSE_STATED_LAG_SIGMA_S if stated else LAG_SIGMA_S,
                drift_sigma=0.0 if stated else _SPARSE_DRIFT_SIGMA_M,
                drift_bend=_SPARSE_DRIFT_BEND_M,
                knot_every=_SPARSE_DRIFT_KNOT_PHOTOS,
            )
        )
    return Priors(
        position=start.position_prior,
        position_sigma=start.position_sigma,
        rotation=start.cameras.rotation.copy(),
        rotation_sigma=np.full((n, 3), np.radians(_SPARSE_FIRST_ATTITUDE_SIGMA_DEG)),
        velocity=start.velocity,
        group=start.records.segment,  # attitude bias, height offset and lag are common to a segment
        models=tuple(models),
        lens=lens,
        lens_sigma=held,
    )


def _free_lens(adjustment: Adjustment, start: SparseStart, *, full: bool) -> None:
    """Lens priors: the focal length from the tags, no distortion."""
    p = adjustment.priors
    lenses = len(start.cameras.lens)
    seen = np.bincount(start.cameras.lens_id[adjustment.tracks.camera], minlength=lenses)
    photos = np.bincount(start.cameras.lens_id, minlength=lenses)
    rich = (seen >= _SPARSE_FULL_LENS_OBSERVATIONS) & (photos >= _SPARSE_FULL_LENS_PHOTOS) & full
    width = start.cameras.lens[:, WIDTH]
    lens = np.zeros((lenses, 6))
    lens[:, 0] = start.log_focal
    sigma = np.zeros((lenses, 6))
    sigma[:, 0], sigma[:, 1], sigma[:, 2] = start.log_focal_sigma, *_SPARSE_LENS_SIGMA
    sigma[rich, 1:4] = _SPARSE_FULL_LENS_SIGMA
    sigma[rich, 4] = sigma[rich, 5] = PRINCIPAL_POINT_SHARE * width[rich]
    now = p.lens + adjustment.common[: 6 * lenses].reshape(-1, 6)
    adjustment.common[: 6 * lenses] = (now - lens).ravel()
    adjustment.priors = replace(p, lens=lens, lens_sigma=sigma)


def _attitude_sigmas_from_residuals(adjustment: Adjustment) -> None:
    """Set the sigmas of the attitude priors to the scatter of adjusted attitudes about them."""
    p = adjustment.priors
    sigma = p.rotation_sigma.copy()
    for g in range(len(p.models)):
        rows = np.flatnonzero(p.group == g)
        bias = bias_axes(p.rotation[rows]) @ adjustment.group_values(g)[0]
        off = log_rotation(np.swapaxes(p.rotation[rows], 1, 2) @ adjustment.cameras.rotation[rows]) - bias
        scatter = mad_sigmas(off)
        sigma[rows] = np.clip(_SPARSE_ATTITUDE_SCATTERS * scatter, *np.radians(_SPARSE_ATTITUDE_RANGE_DEG))
    adjustment.priors = replace(p, rotation_sigma=sigma)


def _rescale_sigmas(adjustment: Adjustment) -> None:
    """Scale the sigmas of all observations so that the median residual matches the redundancy."""
    tracks = adjustment.tracks
    residual = adjustment.residuals()
    off = np.hypot(residual[:, 0], residual[:, 1]) / tracks.sigma_px
    seen = off[np.isfinite(off)]
    if len(seen) < _SPARSE_SCALED_OBSERVATIONS:
        return
    unknowns = 3 * len(adjustment.points) + 6 * len(adjustment.cameras)
    freedom = max(1.0 - unknowns / (2.0 * len(off)), _SPARSE_LEAST_FREEDOM)
    scale = float(np.median(seen)) / (MEDIAN_LENGTH_SIGMAS * np.sqrt(freedom))
    sigma = np.maximum(tracks.sigma_px * np.float32(scale), np.float32(_SPARSE_LEAST_SIGMA_PX))
    adjustment.tracks = replace(tracks, sigma_px=sigma.astype(np.float32))
