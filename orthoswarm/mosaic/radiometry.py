"""Colours of frames evened out, so that neither seams nor facets show: a smooth field of factors for each frame.

Where two frames show the same ground, the logarithm of the ratio of their colours is a measured difference of

    log factor = gain of the vehicle + gain of the frame                       (exposure, white balance)
               + polynomial of the place in the picture, one a vehicle          (vignetting)
               + polynomial of the view direction, one a vehicle                (hot spot, haze)
               + polynomial of the place in the picture, one a frame            (clouds; meadows, water, what is left)

Each difference counts by its sigma, which grows where the thumbnails change much from pixel to pixel: even ground
counts most. All are solved together by robust least squares (Geman-McClure), every unknown held near 0 by a prior,
which also keeps tones from drifting over a large area. Brightness and hue are solved side by side; hue is held
tighter, since meadows and shadows differ in it by themselves. The solution of a frame is a quadratic polynomial of the
place in the picture, which the renderer evaluates at each pixel that it takes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.config import active
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.kernels.lens_arrays import F, U, V
from orthoswarm.mosaic.kernels.render_arrays import Shots
from orthoswarm.mosaic.map_colors import ColorMap, map_colors
from orthoswarm.mosaic.overlap_colors import Bytes, OverlapColors, overlap_colors

Array = NDArray[np.float64]
Field = NDArray[np.float32]
"""Factors of a frame: float32 (3, 6), for red, green and blue the coefficients of 1, x, y, x^2, xy, y^2; x and y are
the place in the picture from its centre, half the picture's width being 1."""

_BRIGHTNESS_HUE = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Red, green, blue to brightness and two differences of hue, an orthonormal change of axes."""
_COMMON, _OWN = 11, 6
"""Vehicle unknowns: gain, five of the lens, five of the view direction. Frame unknowns: gain, two slopes, three
curvatures."""


def uniform(gain: Sequence[float] | NDArray[np.floating]) -> Field:
    """The field of a constant factor (3,)."""
    field = np.zeros((3, 6), np.float32)
    field[:, 0] = gain
    return field


NO_MAP_TONE = "the tones are those of the photos, since no vehicle was found on the basemap"


def tone_warning(fields: Mapping[str, Field]) -> str:
    """By how much pictures were changed to have a map's tone."""
    factors = np.array([field[:, 0] for field in fields.values()]).reshape(-1, 3)
    if len(factors) == 0:
        return "the tones are those of the photos: there is nothing to compare"
    red, green, blue = np.median(factors, axis=0)
    text = f"the tones follow the basemap: red, green and blue times {red:.2f}, {green:.2f} and {blue:.2f} (median)"
    config = active().radiometry
    greatest = config.greatest_factor
    at_limit = float((np.abs(np.log(factors)).max(1) > config.limited_log_share * np.log(greatest)).mean())
    if at_limit > config.limited_share:
        text += (
            f"; {at_limit:.0%} of the photos would need more than {greatest:g}, the greatest factor, and differ from it"
        )
    if max(red, green, blue) > config.tint_ratio * min(red, green, blue):
        text += "; the map has another tint than the photos (season, light, sensor), which the orthoimage now has, too"
    return text


def estimate_fields(
    frames: Sequence[PlacedFrame],
    thumbnails: Mapping[str, Bytes],
    terrain: Terrain,
    held: Mapping[str, Field] | None = None,
    tone: ColorMap | None = None,
) -> dict[str, Field]:
    """Factors that make neighbouring frames alike.

    The mean logarithm of the mosaic's brightness stays as it was, channel by channel; where some fields are held, the
    others follow those instead, and with a map its tone.

    Args:
        frames: placed frames in order of vehicle and time.
        thumbnails: image -> uint8 (rows, columns, 3), means of a picture's parts (RenderStats.thumbnails of an earlier
            rendering); a frame without one gets what its vehicle has in common.
        terrain: the ground's height.
        held: image -> field of frames that are drawn already and stay as they are.
        tone: a map that the mosaic's tone is to follow at low frequency.

    Returns:
        image -> field for every frame; factors lie within `greatest_factor` and its inverse.
    """
    held = held or {}
    known = [i for i, f in enumerate(frames) if f.frame.image in thumbnails]
    if len(known) < 2:
        return {}
    names = sorted({f.frame.vehicle for f in frames})
    vehicle = np.array([names.index(f.frame.vehicle) for f in frames], np.int32)
    shots = Shots.of([f.camera for f in frames], [False] * len(frames))
    some = np.array(known)
    small = np.stack([thumbnails[frames[i].frame.image] for i in known])
    cameras = [frames[i].camera for i in known]
    colors, area = overlap_colors(cameras, shots.take(some), small, terrain)
    fixed = np.array([frames[i].frame.image in held for i in known], bool)
    if fixed.any():
        colors = _with_held(colors, [held.get(frames[i].frame.image) for i in known])
    of_some = vehicle[some]
    shared = None if tone is None else map_colors(cameras, shots.take(some), small, terrain, tone)
    if shared is not None and len(shared.frame):  # the map is one more frame, which is held
        colors = _together(colors, shared)
        of_some, fixed = np.append(of_some, of_some[:1]), np.append(fixed, True)
    of_vehicle, of_known = _solve(colors, of_some, len(names), fixed)
    of_frame = np.zeros((len(frames), _OWN, 3))
    of_frame[some] = of_known[: len(known)]
    x, y = _nodes(shots.size)
    log = _log_factors(of_vehicle[vehicle], of_frame, x=x, y=y, shots=shots, terrain=terrain)
    if not fixed.any() and area.sum() > 0:
        middle = log[some].mean(1)
        log -= (area[:, None] * middle).sum(0) / area.sum()
    limit = float(np.log(active().radiometry.greatest_factor))
    fields = _as_polynomials(np.exp(np.clip(log, -limit, limit)), x, y)
    return {f.frame.image: held.get(f.frame.image, field) for f, field in zip(frames, fields)}


def _together(one: OverlapColors, other: OverlapColors) -> OverlapColors:
    """All samples of two kinds."""
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("frame", "ratio", "place", "sigma")]
    return OverlapColors(*(np.concatenate(pair) for pair in pairs))


def _with_held(colors: OverlapColors, held: Sequence[Field | None]) -> OverlapColors:
    """The samples with the factors of held frames in their ratios."""
    ratio = colors.ratio.copy()
    coefficients = np.stack([uniform(np.ones(3)) if field is None else field for field in held])
    for side, sign in ((0, 1.0), (1, -1.0)):
        x, y = colors.place[:, side, 0], colors.place[:, side, 1]
        basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
        factor = np.einsum("mk,mck->mc", basis, coefficients[colors.frame[:, side]])
        ratio += sign * np.log(np.maximum(factor, active().radiometry.held_least_factor))
    return replace(colors, ratio=ratio.astype(np.float32))


def _solve(
    colors: OverlapColors, vehicle: NDArray[np.int32], vehicles: int, fixed: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Unknowns of vehicles (V, 11, 3) and of frames (N, 6, 3), by conjugate gradients within reweighting rounds."""
    config = active().radiometry
    prior_v = np.array([config.vehicle_sigma, *config.lens_sigmas, *config.view_sigmas]) ** -2.0
    prior_f = np.array([config.picture_sigma, *[config.slope_sigma] * 2, *[config.curve_sigma] * 3]) ** -2.0
    prior = np.concatenate([np.tile(prior_v, vehicles), np.tile(prior_f, len(vehicle))])[:, None] * np.ones(3)
    of_hue = np.ones(len(prior), bool)
    of_hue[: vehicles * _COMMON : _COMMON] = False
    prior[of_hue, 1:] /= config.hue_share**2
    measured = colors.ratio @ _BRIGHTNESS_HUE.T
    precision = np.square(colors.sigma.astype(np.float64)) ** -1
    x = np.zeros((len(prior), 3))
    free = (~fixed).astype(np.float64)
    sample = (colors.frame, colors.place, vehicle, free, vehicles)

    def differences(values: Array) -> Array:
        out = np.empty((len(colors.frame), 3))
        _forward(*sample, values, out)
        return out

    def gathered(weighted: Array) -> Array:
        out = np.zeros_like(x)
        _backward(*sample, weighted, out)
        return out

    for _ in range(config.reweightings):
        residual = differences(x) + measured
        error2 = np.square(residual).mean(1) * precision
        weight = ((1.0 + error2 / config.robust_sigmas**2) ** -2 * precision)[:, None]
        diagonal = np.zeros(len(prior))
        _diagonal(*sample, weight[:, 0], diagonal)
        scale = 1.0 / (diagonal[:, None] + prior)
        # the step from x: (A' W A + P) d = -(A' W r + P x)
        left = -(gathered(weight * residual) + prior * x)
        step, z = np.zeros_like(x), scale * left
        towards, product = z.copy(), (left * z).sum(0)
        enough = config.solver_tolerance**2 * product
        for _ in range(config.solver_steps):
            image = gathered(weight * differences(towards)) + prior * towards
            curve = (towards * image).sum(0)
            alpha = product / np.where(curve > 0.0, curve, 1.0)
            step += alpha * towards
            left -= alpha * image
            z = scale * left
            last, product = product, (left * z).sum(0)
            if (product <= enough).all():
                break
            towards = z + product / np.where(last > 0.0, last, 1.0) * towards
        x += step
    x = x @ _BRIGHTNESS_HUE
    return x[: vehicles * _COMMON].reshape(vehicles, _COMMON, 3), x[vehicles * _COMMON :].reshape(-1, _OWN, 3)


@in_place_kernel
def _bases(place, of_vehicle, of_frame):  # type: ignore[no-untyped-def]
    """Factors of a side's unknowns: (11,) of the vehicle, (6,) of the frame."""
    x, y, e, n = place[0], place[1], place[2], place[3]
    of_vehicle[0], of_vehicle[1], of_vehicle[2] = 1.0, x, y
    of_vehicle[3], of_vehicle[4], of_vehicle[5] = x * x, x * y, y * y
    of_vehicle[6], of_vehicle[7], of_vehicle[8], of_vehicle[9], of_vehicle[10] = e, n, e * e, e * n, n * n
    of_frame[0], of_frame[1], of_frame[2] = 1.0, x, y
    of_frame[3], of_frame[4], of_frame[5] = x * x, x * y, y * y


@kernel
def _forward(frame, place, vehicle, free, vehicles, values, out):  # type: ignore[no-untyped-def]
    """Difference of the log factors of the two sides of each sample (M, 3)."""
    of_vehicle, of_frame = np.empty(_COMMON), np.empty(_OWN)
    out[:] = 0.0
    for m in range(len(frame)):
        for side in range(2):
            k = frame[m, side]
            sign = (1.0 - 2.0 * side) * free[k]
            if sign == 0.0:
                continue
            _bases(place[m, side], of_vehicle, of_frame)
            first = _COMMON * vehicle[k]
            for q in range(_COMMON):
                factor = sign * of_vehicle[q]
                for channel in range(3):
                    out[m, channel] += factor * values[first + q, channel]
            first = _COMMON * vehicles + _OWN * k
            for q in range(_OWN):
                factor = sign * of_frame[q]
                for channel in range(3):
                    out[m, channel] += factor * values[first + q, channel]


@kernel
def _backward(frame, place, vehicle, free, vehicles, weighted, out):  # type: ignore[no-untyped-def]
    """The transpose of `_forward`: samples' values gathered in the unknowns (added to out)."""
    of_vehicle, of_frame = np.empty(_COMMON), np.empty(_OWN)
    for m in range(len(frame)):
        for side in range(2):
            k = frame[m, side]
            sign = (1.0 - 2.0 * side) * free[k]
            if sign == 0.0:
                continue
            _bases(place[m, side], of_vehicle, of_frame)
            first = _COMMON * vehicle[k]
            for q in range(_COMMON):
                factor = sign * of_vehicle[q]
                for channel in range(3):
                    out[first + q, channel] += factor * weighted[m, channel]
            first = _COMMON * vehicles + _OWN * k
            for q in range(_OWN):
                factor = sign * of_frame[q]
                for channel in range(3):
                    out[first + q, channel] += factor * weighted[m, channel]


@kernel
def _diagonal(frame, place, vehicle, free, vehicles, weight, out):  # type: ignore[no-untyped-def]
    """The diagonal of the normal matrix (added to out).

    Of two frames of one vehicle, its unknowns count by the difference of the two places, which for the gain is none.
    """
    of_vehicle, of_frame = np.empty((2, _COMMON)), np.empty(_OWN)
    for m in range(len(frame)):
        for side in range(2):
            k = frame[m, side]
            _bases(place[m, side], of_vehicle[side], of_frame)
            of_vehicle[side] *= free[k]
            for q in range(_OWN):
                out[_COMMON * vehicles + _OWN * k + q] += weight[m] * free[k] * of_frame[q] * of_frame[q]
        one, other = vehicle[frame[m, 0]], vehicle[frame[m, 1]]
        for q in range(_COMMON):
            if one == other:
                out[_COMMON * one + q] += weight[m] * (of_vehicle[0, q] - of_vehicle[1, q]) ** 2
            else:
                out[_COMMON * one + q] += weight[m] * of_vehicle[0, q] ** 2
                out[_COMMON * other + q] += weight[m] * of_vehicle[1, q] ** 2


def _nodes(size: NDArray[np.int32]) -> tuple[Array, Array]:
    """Places in the pictures (N, nodes^2) at which fields are fitted."""
    count = active().radiometry.nodes
    across = np.linspace(-1.0, 1.0, count)
    x = np.tile(across, count)
    y = np.repeat(across, count)[None, :] * (size[:, 1] / size[:, 0])[:, None]
    return np.broadcast_to(x, y.shape), y


def _log_factors(of_vehicle: Array, of_frame: Array, *, x: Array, y: Array, shots: Shots, terrain: Terrain) -> Array:
    """Log factors (N, nodes, 3) of frames with their vehicles' unknowns (N, 11, 3) and their own (N, 6, 3)."""
    half = 0.5 * shots.size[:, :1]
    u, v = half * (x + 1.0) - 0.5, half * y + 0.5 * shots.size[:, 1:] - 0.5
    rays = np.stack([(u - shots.lens[:, [U]]) / shots.lens[:, [F]], (v - shots.lens[:, [V]]) / shots.lens[:, [F]]], -1)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ shots.rotation.transpose(0, 2, 1)
    flattest = active().radiometry.flattest_descent
    down = np.maximum(-rays[..., 2:], flattest * np.linalg.norm(rays, axis=-1, keepdims=True))
    e, n = np.moveaxis(rays[..., :2] / down, -1, 0)
    one = np.ones_like(y)
    common = np.stack([one, x, y, x * x, x * y, y * y, e, n, e * e, e * n, n * n], -1)
    own = np.stack([one, x, y, x * x, x * y, y * y], -1)
    return np.asarray(common @ of_vehicle + own @ of_frame)


def _as_polynomials(factor: Array, x: Array, y: Array) -> Field:
    """Coefficients (N, 3, 6) of the polynomials nearest to factors (N, nodes, 3) at places (N, nodes)."""
    basis = np.stack([np.ones_like(y), x, y, x * x, x * y, y * y], -1)
    normal = np.swapaxes(basis, 1, 2) @ basis
    right = np.swapaxes(basis, 1, 2) @ factor
    return np.ascontiguousarray(np.swapaxes(np.linalg.solve(normal, right), 1, 2), np.float32)
