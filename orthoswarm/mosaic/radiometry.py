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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.compute.robust_kernel import robust_weight
from orthoswarm.compute.threads import on_threads
from orthoswarm.model.arrays import Array, Bytes, Flags, Ints
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.kernels.lens_arrays import F, U, V
from orthoswarm.mosaic.kernels.render_arrays import Shots
from orthoswarm.mosaic.map_colors import ColorMap, map_colors
from orthoswarm.mosaic.overlap_colors import OverlapColors, overlap_colors

Field = NDArray[np.float32]
"""Factors of a frame: float32 (3, 6), for red, green and blue the coefficients of 1, x, y, x^2, xy, y^2; x and y are
the place in the picture from its centre, half the picture's width being 1."""

_BRIGHTNESS_HUE = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
"""Red, green, blue to brightness and two differences of hue, an orthonormal change of axes."""
_COMMON, _OWN = 11, 6
"""Vehicle unknowns: gain, five of the lens, five of the view direction. Frame unknowns: gain, two slopes, three
curvatures."""


_PARTS = 8  # parts in which samples are summed, at most so many threads (chosen)

_ROBUST_SIGMAS: Final = 3.0  # scale of the Geman-McClure kernel on these ratios, sigmas
_VEHICLE_SIGMA: Final = 0.30  # log gain of a vehicle's camera: another exposure or white balance
_PICTURE_SIGMA: Final = 0.06  # log gain of a picture: automatic exposure within a flight
_LENS_SIGMAS: Final = (0.05, 0.05, 0.15, 0.05, 0.15)
"""x, y, x^2, xy, y^2 of a vehicle's vignetting, half the picture's width being 1: corners may be darker by a fifth or
so."""
_VIEW_SIGMAS: Final = (0.15, 0.15, 0.10, 0.10, 0.10)
"""e, n, e^2, en, n^2 of the view direction's tangents; chosen (two suburbs: 0.14 to 0.22 a tangent found)."""
_SLOPE_SIGMA: Final = 0.07  # a picture's own slopes; by steps on even ground of three flights
_CURVE_SIGMA: Final = 0.06  # a picture's own curvatures, x^2, xy, y^2; chosen with the slopes
_HUE_SHARE: Final = 0.35  # how much less than brightness hue may vary; by looking at four sets
GREATEST_FACTOR: Final = 1.8  # greatest factor, and the least is its inverse: what would need more has another cause
_HELD_LEAST_FACTOR: Final = 0.1
"""Factors of pictures that keep theirs count as at least so much where their logarithm is needed."""
_FLATTEST_DESCENT: Final = 0.2  # rays count as falling at least so much for their length
_LIMITED_SHARE: Final = 0.02
"""A warning says how many photos would need more than the greatest factor if more than so many do ..."""
_LIMITED_LOG_SHARE: Final = 0.95  # ... which is taken from this share of its logarithm on
_TINT_RATIO: Final = 1.15
"""A warning says that a map has another tint where its colours' factors differ by more than this."""
_REWEIGHTINGS: Final = 3
"""Rounds of reweighting; then factors lie within 0.2 % of where 40 rounds lead (154 pictures of three vehicles of
different tone and 1,017 of ten)."""
_SOLVER_STEPS: Final = 100  # most steps of conjugate gradients a round (4 to 15 were needed)
_SOLVER_TOLERANCE: Final = 0.1
"""Preconditioned residual, as a share of the first one, at which a round ends; the next one goes on from there (0.01
takes 1.7 times the time and changes factors by 0.03 % at most)."""
_FIELDS_AT_ONCE: Final = 2048  # pictures whose factors are evaluated at once, 15 kB each
_NODES: Final = 7  # nodes along each side of a picture to which its quadratic polynomial is fitted


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
    most = GREATEST_FACTOR
    at_limit = float((np.abs(np.log(factors)).max(1) > _LIMITED_LOG_SHARE * np.log(most)).mean())
    if at_limit > _LIMITED_SHARE:
        text += f"; {at_limit:.0%} of the photos would need more than {most:g}, the greatest factor, and differ from it"
    if max(red, green, blue) > _TINT_RATIO * min(red, green, blue):
        text += "; the map has another tint than the photos (season, light, sensor), which the orthoimage now has, too"
    return text


def estimate_fields(
    frames: Sequence[PlacedFrame],
    thumbnails: Mapping[str, Bytes],
    terrain: Terrain,
    held: Mapping[str, Field] | None = None,
    *,
    tone: ColorMap | None = None,
    threads: int = 1,
) -> dict[str, Field]:
    """Factors that make neighbouring frames alike: image -> field, within `GREATEST_FACTOR` and its inverse.

    The mean logarithm of the mosaic's brightness stays as it was, channel by channel; where some fields are held, the
    others follow those instead, and with a map its tone.

    Args:
        frames: placed frames in order of vehicle and time. terrain: the ground's height.
        thumbnails: image -> uint8 (rows, columns, 3), means of a picture's parts (RenderStats.thumbnails of an earlier
            rendering); a frame without one gets what its vehicle has in common.
        held: image -> field of frames that are drawn already and stay as they are.
        tone: a map that the mosaic's tone is to follow at low frequency. threads: do not change the result.
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
    colors, area = overlap_colors(cameras, shots.take(some), small, terrain, threads)
    fixed = np.array([frames[i].frame.image in held for i in known], bool)
    if fixed.any():
        colors = _with_held(colors, [held.get(frames[i].frame.image) for i in known])
    of_some = vehicle[some]
    shared = None if tone is None else map_colors(cameras, shots.take(some), small, terrain, tone)
    if shared is not None and len(shared.frame):  # the map is one more frame, which is held
        colors = OverlapColors.joined([colors, shared])
        of_some, fixed = np.append(of_some, of_some[:1]), np.append(fixed, True)
    of_vehicle, of_known = _solve(colors, of_some, len(names), fixed, threads)
    del colors  # 5 kB a picture
    of_frame = np.zeros((len(frames), _OWN, 3))
    of_frame[some] = of_known[: len(known)]
    every, at_once = np.arange(len(frames)), _FIELDS_AT_ONCE
    blocks = [every[first : first + at_once] for first in range(0, len(frames), at_once)]
    log = np.concatenate([_log_factors(of_vehicle[vehicle[b]], of_frame[b], shots.take(b)) for b in blocks])
    if not fixed.any() and area.sum() > 0:
        middle = log[some].mean(1)
        log -= (area[:, None] * middle).sum(0) / area.sum()
    limit = float(np.log(GREATEST_FACTOR))
    factor = np.exp(np.clip(log, -limit, limit))
    fields = np.concatenate([_as_polynomials(factor[b], shots.size[b]) for b in blocks])
    return {f.frame.image: held.get(f.frame.image, field) for f, field in zip(frames, fields)}


def _with_held(colors: OverlapColors, held: Sequence[Field | None]) -> OverlapColors:
    """The samples with the factors of held frames in their ratios."""
    ratio = colors.ratio.copy()
    coefficients = np.stack([uniform(np.ones(3)) if field is None else field for field in held])
    for side, sign in ((0, 1.0), (1, -1.0)):
        x, y = colors.place[:, side, 0], colors.place[:, side, 1]
        basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
        factor = np.einsum("mk,mck->mc", basis, coefficients[colors.frame[:, side]])
        ratio += sign * np.log(np.maximum(factor, _HELD_LEAST_FACTOR))
    return replace(colors, ratio=ratio.astype(np.float32))


def _solve(colors: OverlapColors, vehicle: Ints, vehicles: int, fixed: Flags, threads: int) -> tuple[Array, Array]:
    """Unknowns of vehicles (V, 11, 3) and of frames (N, 6, 3), by conjugate gradients within reweighting rounds."""
    prior_v = np.array([_VEHICLE_SIGMA, *_LENS_SIGMAS, *_VIEW_SIGMAS]) ** -2.0
    prior_f = np.array([_PICTURE_SIGMA, *[_SLOPE_SIGMA] * 2, *[_CURVE_SIGMA] * 3]) ** -2.0
    prior = np.concatenate([np.tile(prior_v, vehicles), np.tile(prior_f, len(vehicle))])[:, None] * np.ones(3)
    of_hue = np.ones(len(prior), bool)
    of_hue[: vehicles * _COMMON : _COMMON] = False
    prior[of_hue, 1:] /= _HUE_SHARE**2
    samples = _Samples(colors, vehicle, vehicles, (~fixed).astype(np.float64), threads)
    x = np.zeros((len(prior), 3))
    for _ in range(_REWEIGHTINGS):
        right, diagonal = samples.weigh(x)
        # the step from x: (A' W A + P) d = -(A' W r + P x)
        x += conjugate_gradients(
            lambda towards: samples.applied(towards) + prior * towards, diagonal[:, None] + prior,
            -(right + prior * x), _SOLVER_TOLERANCE, _SOLVER_STEPS,
        )  # fmt: skip
    x = x @ _BRIGHTNESS_HUE
    return x[: vehicles * _COMMON].reshape(vehicles, _COMMON, 3), x[vehicles * _COMMON :].reshape(-1, _OWN, 3)


def conjugate_gradients(
    applied: Callable[[Array], Array], diagonal: Array, right: Array, tolerance: float, most_steps: int
) -> Array:
    """The solutions (M, K) of K systems with one positive definite matrix, preconditioned by its diagonal.

    applied: the matrix times (M, K). diagonal: of the matrix, (M, 1) or (M, K). right: (M, K). tolerance:
    preconditioned residual at which they end, as a share of the first one.
    """
    x, left, scale = np.zeros_like(right), right.copy(), 1.0 / diagonal
    z = scale * left
    towards, product = z.copy(), (left * z).sum(0)
    enough = tolerance**2 * product
    for _ in range(most_steps):
        if (product <= enough).all():
            break
        image = applied(towards)
        curve = (towards * image).sum(0)
        alpha = product / np.where(curve > 0.0, curve, 1.0)
        x += alpha * towards
        left -= alpha * image
        z = scale * left
        last, product = product, (left * z).sum(0)
        towards = z + product / np.where(last > 0.0, last, 1.0) * towards
    return x


class _Samples:
    """The samples in the normal equations, without a matrix: A gives the difference of a sample's two sides.

    They are summed in parts, always the same ones, so that the result does not depend on the number of threads.
    """

    def __init__(self, colors: OverlapColors, vehicle: Ints, vehicles: int, free: Array, threads: int) -> None:
        self._threads = threads
        edges = np.linspace(0, len(colors.frame), _PARTS + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(edges.tolist())]
        self._unknowns = [(colors.frame[p], colors.place[p], vehicle, free, vehicles) for p in parts]
        self._measured = [(colors.ratio[p], colors.sigma[p]) for p in parts]
        self._weights = [np.empty(p.stop - p.start) for p in parts]

    def weigh(self, x: Array) -> tuple[Array, Array]:
        """Set the weights W by the residuals r at x; returns A' W r and the diagonal of A' W A."""

        def part(k: int) -> tuple[Array, Array]:
            right, diagonal = np.zeros_like(x), np.zeros(len(x))
            seen, weight = self._measured[k], self._weights[k]
            _weigh(*self._unknowns[k], *seen, _BRIGHTNESS_HUE, x, weight, right, diagonal)
            return right, diagonal

        rights, diagonals = zip(*on_threads(part, range(_PARTS), self._threads), strict=True)
        return np.asarray(sum(rights)), np.asarray(sum(diagonals))

    def applied(self, x: Array) -> Array:
        """A' W A x."""

        def part(k: int) -> Array:
            out = np.zeros_like(x)
            _apply(*self._unknowns[k], self._weights[k], x, out)
            return out

        return np.asarray(sum(on_threads(part, range(_PARTS), self._threads)))


@in_place_kernel
def _bases(frame, place, vehicle, free, of_vehicle, of_frame):  # type: ignore[no-untyped-def]
    """Factors of the unknowns in a sample, less those of its other frame: (2, 11) of vehicles and (2, 6) of frames.

    Returns how many vehicles it has: of two frames of one vehicle, row 0 is the difference of the two places.
    """
    for side in range(2):
        x, y, e, n = place[side, 0], place[side, 1], place[side, 2], place[side, 3]
        one = (1.0 - 2.0 * side) * free[frame[side]]
        own, lens = of_frame[side], of_vehicle[side]
        own[0], own[1], own[2], own[3], own[4], own[5] = one, one * x, one * y, one * x * x, one * x * y, one * y * y
        for q in range(_OWN):
            lens[q] = own[q]
        lens[6], lens[7], lens[8], lens[9], lens[10] = one * e, one * n, one * e * e, one * e * n, one * n * n
    if vehicle[frame[0]] != vehicle[frame[1]]:
        return 2
    for q in range(_COMMON):
        of_vehicle[0, q] += of_vehicle[1, q]
    return 1


@in_place_kernel
def _difference(frame, vehicle, vehicles, of_vehicle, of_frame, count, values):  # type: ignore[no-untyped-def]
    """Difference of the log factors of a sample's two frames, three numbers; count: see `_bases`."""
    a, b, c = 0.0, 0.0, 0.0
    for side in range(count):
        first = _COMMON * vehicle[frame[side]]
        for q in range(_COMMON):
            factor, own = of_vehicle[side, q], values[first + q]
            a, b, c = a + factor * own[0], b + factor * own[1], c + factor * own[2]
    for side in range(2):
        first = _COMMON * vehicles + _OWN * frame[side]
        for q in range(_OWN):
            factor, own = of_frame[side, q], values[first + q]
            a, b, c = a + factor * own[0], b + factor * own[1], c + factor * own[2]
    return a, b, c


@in_place_kernel
def _gather(frame, vehicle, vehicles, of_vehicle, of_frame, count, a, b, c, out):  # type: ignore[no-untyped-def]
    """The transpose of `_difference`: three numbers of a sample, added to the unknowns in out."""
    for side in range(count):
        first = _COMMON * vehicle[frame[side]]
        for q in range(_COMMON):
            factor, own = of_vehicle[side, q], out[first + q]
            own[0], own[1], own[2] = own[0] + factor * a, own[1] + factor * b, own[2] + factor * c
    for side in range(2):
        first = _COMMON * vehicles + _OWN * frame[side]
        for q in range(_OWN):
            factor, own = of_frame[side, q], out[first + q]
            own[0], own[1], own[2] = own[0] + factor * a, own[1] + factor * b, own[2] + factor * c


@kernel
def _weigh(  # type: ignore[no-untyped-def]
    frame, place, vehicle, free, vehicles, ratio, sigma, axes, values, weight, right, diagonal
):
    """Weights (M,) of samples by their residuals, and what they add to the right side and to the diagonal."""
    of_vehicle, of_frame = np.empty((2, _COMMON)), np.empty((2, _OWN))
    for m in range(len(frame)):
        count = _bases(frame[m], place[m], vehicle, free, of_vehicle, of_frame)
        a, b, c = _difference(frame[m], vehicle, vehicles, of_vehicle, of_frame, count, values)
        red, green, blue = ratio[m, 0], ratio[m, 1], ratio[m, 2]
        a += axes[0, 0] * red + axes[0, 1] * green + axes[0, 2] * blue
        b += axes[1, 0] * red + axes[1, 1] * green + axes[1, 2] * blue
        c += axes[2, 0] * red + axes[2, 1] * green + axes[2, 2] * blue
        precision = 1.0 / (float(sigma[m]) * float(sigma[m]))
        w = robust_weight((a * a + b * b + c * c) / 3.0 * precision, _ROBUST_SIGMAS**2, precision)
        weight[m] = w
        _gather(frame[m], vehicle, vehicles, of_vehicle, of_frame, count, w * a, w * b, w * c, right)
        for side in range(count):
            for q in range(_COMMON):
                diagonal[_COMMON * vehicle[frame[m, side]] + q] += w * of_vehicle[side, q] ** 2
        for side in range(2):
            for q in range(_OWN):
                diagonal[_COMMON * vehicles + _OWN * frame[m, side] + q] += w * of_frame[side, q] ** 2


@kernel
def _apply(frame, place, vehicle, free, vehicles, weight, values, out):  # type: ignore[no-untyped-def]
    """A' W A values, added to out."""
    of_vehicle, of_frame = np.empty((2, _COMMON)), np.empty((2, _OWN))
    for m in range(len(frame)):
        count, w = _bases(frame[m], place[m], vehicle, free, of_vehicle, of_frame), weight[m]
        a, b, c = _difference(frame[m], vehicle, vehicles, of_vehicle, of_frame, count, values)
        _gather(frame[m], vehicle, vehicles, of_vehicle, of_frame, count, w * a, w * b, w * c, out)


def _nodes(size: Ints) -> tuple[Array, Array]:
    """Places in the pictures (N, nodes^2) at which fields are fitted."""
    count = _NODES
    across = np.linspace(-1.0, 1.0, count)
    x = np.tile(across, count)
    y = np.repeat(across, count)[None, :] * (size[:, 1] / size[:, 0])[:, None]
    return np.broadcast_to(x, y.shape), y


def _log_factors(of_vehicle: Array, of_frame: Array, shots: Shots) -> Array:
    """Log factors (N, nodes, 3) of frames with their vehicles' unknowns (N, 11, 3) and their own (N, 6, 3)."""
    x, y = _nodes(shots.size)
    half = 0.5 * shots.size[:, :1]
    u, v = half * (x + 1.0) - 0.5, half * y + 0.5 * shots.size[:, 1:] - 0.5
    rays = np.stack([(u - shots.lens[:, [U]]) / shots.lens[:, [F]], (v - shots.lens[:, [V]]) / shots.lens[:, [F]]], -1)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1) @ shots.rotation.transpose(0, 2, 1)
    flattest = _FLATTEST_DESCENT
    down = np.maximum(-rays[..., 2:], flattest * np.linalg.norm(rays, axis=-1, keepdims=True))
    e, n = np.moveaxis(rays[..., :2] / down, -1, 0)
    one = np.ones_like(y)
    common = np.stack([one, x, y, x * x, x * y, y * y, e, n, e * e, e * n, n * n], -1)
    own = np.stack([one, x, y, x * x, x * y, y * y], -1)
    return np.asarray(common @ of_vehicle + own @ of_frame)


def _as_polynomials(factor: Array, size: Ints) -> Field:
    """Coefficients (N, 3, 6) of the polynomials nearest to factors (N, nodes, 3) of pictures of these sizes (N, 2)."""
    x, y = _nodes(size)
    basis = np.stack([np.ones_like(y), x, y, x * x, x * y, y * y], -1)
    normal = np.swapaxes(basis, 1, 2) @ basis
    right = np.swapaxes(basis, 1, 2) @ factor
    return np.ascontiguousarray(np.swapaxes(np.linalg.solve(normal, right), 1, 2), np.float32)
