"""Photos without positions are placed by their pairs and by what surveyed points they show."""

import numpy as np
import pytest

from orthoswarm.refine.initial.free_network import Anchors, solve_free_network
from orthoswarm.refine.initial.planar_similarity import PairGraph
from orthoswarm.refine.strategy.unpositioned_photos import candidate_pairs

WIDTH = 1000.0


def similarities_of(count, seed):
    """Scales (metres per pixel and heading) and centres of photos on a wandering path."""
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.04, 0.06, count) * np.exp(1j * rng.uniform(-np.pi, np.pi, count))
    return scale, np.cumsum(rng.uniform(8, 14, count) * np.exp(1j * rng.uniform(-0.6, 0.6, count)))


def graph_of(scale, centre, pairs, noise=0.0, seed=0):
    """Pairs that show the ground half way between their photos, with noise in pixels."""
    rng = np.random.default_rng(seed)
    first, second = np.array(pairs, np.int32).T
    ground = 0.5 * (centre[first] + centre[second])
    ratio = scale[first] / scale[second] * np.exp(noise / WIDTH * rng.normal(size=(len(pairs), 2)) @ [1, 1j])
    shown = [
        (ground - centre[k]) / scale[k] + noise * rng.normal(size=(len(pairs), 2)) @ [1, 1j] for k in (first, second)
    ]
    n = len(pairs)
    return PairGraph(
        first=first, second=second, factor=ratio, centre_first=shown[0], centre_second=shown[1],
        count=np.full(n, 100), spread=np.full(n, 200.0), residual=np.full(n, 1.0),
    )  # fmt: skip


def anchors_of(scale, centre, photos, seed=1, wrong=()):
    rng = np.random.default_rng(seed)
    photos = np.array(photos, np.int32)
    pixel = rng.uniform(-300, 300, (len(photos), 2)) @ np.array([1, 1j])
    ground = scale[photos] * pixel + centre[photos]
    ground[list(wrong)] += 40.0
    n = len(photos)
    return Anchors(
        photo=photos, pixel=pixel, ground=ground, sigma_m=np.full(n, 0.05), sigma_px=np.full(n, 0.02 * WIDTH)
    )


@pytest.mark.parametrize("seed", range(5))
def test_exact_pairs_and_two_points_give_the_photos_back(seed):
    scale, centre = similarities_of(12, seed)
    pairs = [(k, k + 1) for k in range(11)] + [(k, k + 2) for k in range(10)]
    found = solve_free_network(
        graph_of(scale, centre, pairs), 12, np.full(12, WIDTH), anchors_of(scale, centre, [0, 11])
    )
    assert found.placed.all()
    assert np.abs(found.centre - centre).max() < 1e-4
    assert np.abs(found.scale / scale - 1.0).max() < 1e-5


@pytest.mark.parametrize("seed", range(5))
def test_a_wrong_point_and_a_wrong_pair_are_overruled_and_the_sigma_is_that_of_the_error(seed):
    scale, centre = similarities_of(20, seed)
    pairs = [(k, k + d) for d in (1, 2, 3) for k in range(20 - d)]
    graph = graph_of(scale, centre, pairs, noise=8.0, seed=seed)
    graph.factor[25] *= 1.5j  # a pair across streets that look alike
    graph.centre_second[25] += 400.0
    anchors = anchors_of(scale, centre, [0, 6, 12, 19, 9], wrong=[4])
    found = solve_free_network(graph, 20, np.full(20, WIDTH), anchors)
    error = np.abs(found.centre - centre)
    assert error.max() < 2.0 and np.sqrt((error**2 / (2 * found.sigma_m**2)).mean()) < 1.5


def test_parts_without_two_points_are_not_placed():
    scale, centre = similarities_of(9, 3)
    pairs = [(0, 1), (1, 2), (3, 4), (4, 5), (6, 7)]  # 8 shows nothing of the others
    anchors = anchors_of(scale, centre, [0, 2, 3])
    found = solve_free_network(graph_of(scale, centre, pairs), 9, np.full(9, WIDTH), anchors)
    assert found.placed.tolist() == [True] * 3 + [False] * 6


def test_photos_whose_pairs_contradict_each_other_are_no_block():
    """Their sigmas grow with their scale, so they shrank to one point that agreed with one anchor."""
    scale, centre = similarities_of(12, 4)
    pairs = [(k, k + d) for d in (1, 2, 3) for k in range(12 - d)]
    graph = graph_of(scale, centre, pairs)
    graph.centre_second[:] += np.random.default_rng(1).normal(scale=2000.0, size=(len(pairs), 2)) @ [1, 1j]
    found = solve_free_network(graph, 12, np.full(12, WIDTH), anchors_of(scale, centre, [0, 11]))
    assert not found.placed.any() and [part.tolist() for part in found.left] == [list(range(12))]


def test_only_pairs_that_can_place_a_photo_are_tried():
    pairs = candidate_pairs(2, 5)
    assert pairs.tolist() == [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [1, 3], [1, 4]]
