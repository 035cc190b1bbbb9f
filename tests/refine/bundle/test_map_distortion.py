"""A map that is displaced from place to place: what a block is displaced by with it is estimated from its ties."""

import numpy as np
import pytest

from benchmarks.accuracy.sigma_truth import warped
from orthoswarm.refine.bundle.covariance import map_distortion_variance

HEIGHT_M = 150.0
NOISE_M = 0.1


def similarity_of(place, moved):
    """Shift, turn and scale (n, 2) that fit displacements (n, 2) at places (n, 2) best."""
    x, y = (place - place.mean(axis=0)).T
    one, zero = np.ones(len(x)), np.zeros(len(x))
    rows = np.concatenate([np.column_stack([one, zero, x, -y]), np.column_stack([zero, one, y, x])])
    values = np.linalg.lstsq(rows, np.concatenate([moved[:, 0], moved[:, 1]]), rcond=None)[0]
    return (rows @ values).reshape(2, -1).T


def displaced(place, rms_m, length_m, seed):
    """A smooth random field (n, 2) with a Gaussian correlation, at places (n, 2)."""
    rng = np.random.default_rng(seed)
    apart2 = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    root = np.linalg.cholesky(np.exp(-0.5 * apart2 / length_m**2) + 1e-6 * np.eye(len(place)))
    return rms_m / np.sqrt(2) * root @ rng.normal(size=(len(place), 2))


def block_on(rms_m, length_m, seed, noise_m=NOISE_M):
    """Places, residuals and the errors of a rigid block of ties over 500 m on a displaced map."""
    rng = np.random.default_rng(1000 + seed)
    place = rng.uniform(0.0, 500.0, (200, 2))
    field = displaced(place, rms_m, length_m, seed) if rms_m else np.zeros_like(place)
    followed = similarity_of(place, field)
    return place, field - followed + rng.normal(0.0, noise_m, place.shape), followed


@pytest.mark.parametrize("length_m", [50.0, 100.0, 150.0, 250.0])
@pytest.mark.parametrize("rms_m", [1.0, 3.0])
def test_the_error_that_a_block_takes_over_is_found_on_average(rms_m, length_m):
    found, true = [], []
    for seed in range(12):
        place, residual, followed = block_on(rms_m, length_m, seed)
        found.append(map_distortion_variance(place, residual, HEIGHT_M))
        true.append(float((followed**2).mean()))
    assert 0.5 * np.mean(true) < np.mean(found) < 2.0 * np.mean(true)


def test_noise_is_no_distortion():
    place, residual, _ = block_on(0.0, 1.0, 1, noise_m=0.3)
    assert map_distortion_variance(place, residual, HEIGHT_M) < 0.05**2


def test_wrong_ties_do_not_matter():
    place, residual, _ = block_on(2.0, 100.0, 4)
    found = map_distortion_variance(place, residual, HEIGHT_M)
    residual[::12] += 8.0
    assert map_distortion_variance(place, residual, HEIGHT_M) == pytest.approx(found, rel=0.5)


@pytest.mark.parametrize("ties", [0, 1, 2, 5, 8])
def test_few_ties_tell_nothing(ties):
    place, residual, _ = block_on(2.0, 100.0, 4)
    assert map_distortion_variance(place[:ties], residual[:ties], HEIGHT_M) == 0.0


def test_ties_along_one_line_are_no_error():
    place, residual, _ = block_on(2.0, 100.0, 4)
    place[:, 1] = 0.0
    assert np.isfinite(map_distortion_variance(place, residual, HEIGHT_M))
    assert map_distortion_variance(np.zeros_like(place), residual, HEIGHT_M) == 0.0


def test_maps_of_the_benchmark_have_the_stated_displacement():
    """The ground is displaced by as much as the kind of map says: a ramp shows by how much."""
    columns = np.arange(600, dtype=np.float32)
    ramp = np.broadcast_to(columns, (1, 600, 600)).copy()
    moved = np.concatenate([(warped(ramp, 1.0, 2.0, 50.0, seed) - ramp)[0, 50:-50, 50:-50].ravel() for seed in (1, 2)])
    assert np.sqrt(2 * moved.var()) == pytest.approx(2.0, rel=0.25)
