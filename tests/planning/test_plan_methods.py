import itertools

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

from orthoswarm.planning.lines.bcd import bcd_legs, cells, critical_points, order_cells
from orthoswarm.planning.lines.bricks import joins, maximum_matching
from orthoswarm.planning.lines.candidates import column_legs
from orthoswarm.planning.lines.detours import Router, make_obstacles
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.lines.spanning_tree import circumnavigate, spanning_edges
from orthoswarm.planning.lines.sweep_lines import Field
from orthoswarm.planning.lines.tmstc import tmstc_legs
from orthoswarm.planning.lines.visiting_order import shorten

FOOT = footprint(60.0, np.radians(60.0))
FREE = shapely.MultiPolygon()
U_SHAPE = shapely.Polygon([(0, 0), (900, 0), (900, 700), (600, 700), (600, 300), (300, 300), (300, 700), (0, 700)])
WITH_HOLE = shapely.Polygon(
    [(0, 0), (600, 0), (600, 400), (0, 400)], [[(250, 150), (350, 160), (340, 260), (240, 250)]]
)


def count_turns(loop):
    """Changes of direction on a closed path of sub-cells (n, 2)."""
    steps = np.diff(np.concatenate([loop, loop[:1]]), axis=0)
    return int((steps != np.roll(steps, 1, axis=0)).any(1).sum())


@settings(max_examples=60, deadline=None)
@given(arrays(np.bool_, st.tuples(st.integers(1, 12), st.integers(1, 12))))
def test_matching_is_as_large_as_scipys(graph):
    start = np.concatenate([[0], np.cumsum(graph.sum(1))]).astype(np.int64)
    links = np.nonzero(graph)[1].astype(np.int64)
    mates, _ = maximum_matching(start, links, graph.shape[1])
    matched = np.flatnonzero(mates >= 0)
    assert all(graph[u, mates[u]] for u in matched)
    assert len(set(mates[matched])) == len(matched)
    assert len(matched) == (maximum_bipartite_matching(csr_matrix(graph), perm_type="column") >= 0).sum()


def fewest_bricks(grid):
    """By trying: each cell lies along x or along y, and a brick is a run of alike neighbours."""
    where = [tuple(c) for c in np.argwhere(grid)]
    best = len(where)
    for along_x in itertools.product([True, False], repeat=len(where)):
        way = dict(zip(where, along_x, strict=True))
        joined = sum(
            way[i, j] == along and way.get((i + along, j + (not along))) == along
            for i, j in where
            for along in (True, False)
        )
        best = min(best, len(where) - joined)
    return best


@settings(max_examples=40, deadline=None)
@given(arrays(np.bool_, st.tuples(st.integers(1, 4), st.integers(1, 3)), elements=st.booleans()))
def test_bricks_are_as_few_as_trying_all_finds(grid):
    x_joins, y_joins = joins(grid)
    assert grid.sum() - x_joins.sum() - y_joins.sum() == fewest_bricks(grid)


@settings(max_examples=40, deadline=None)
@given(arrays(np.bool_, st.tuples(st.integers(2, 14), st.integers(2, 14)), elements=st.booleans()))
def test_no_cell_is_joined_both_ways(grid):
    x_joins, y_joins = joins(grid)
    in_x, in_y = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    in_x[:-1] |= x_joins
    in_x[1:] |= x_joins
    in_y[:, :-1] |= y_joins
    in_y[:, 1:] |= y_joins
    assert not (in_x & in_y).any()
    assert grid[in_x | in_y].all()


@settings(max_examples=40, deadline=None)
@given(arrays(np.bool_, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.booleans()))
def test_the_round_trip_visits_every_sub_cell_once_and_comes_back(grid):
    loops = circumnavigate(grid, spanning_edges(grid, *joins(grid)))
    for loop in loops:
        steps = np.abs(np.diff(np.concatenate([loop, loop[:1]]), axis=0)).sum(1)
        assert (steps == 1).all()
    visited = np.concatenate(loops) if loops else np.empty((0, 2), int)
    expected = np.argwhere(np.kron(grid, np.ones((2, 2), bool)))
    assert sorted(map(tuple, visited.tolist())) == sorted(map(tuple, expected.tolist()))


def test_there_is_one_round_trip_for_each_connected_part():
    grid = np.ones((5, 7), bool)
    grid[2] = False
    assert len(circumnavigate(grid, spanning_edges(grid, *joins(grid)))) == 2


@pytest.mark.parametrize("shape", [(1, 1), (6, 6), (3, 9), (100, 100)])
def test_a_full_rectangle_turns_no_oftener_than_up_and_down(shape):
    grid = np.ones(shape, bool)
    (loop,) = circumnavigate(grid, spanning_edges(grid, *joins(grid)))
    assert count_turns(loop) == 4 * min(shape)


@pytest.mark.parametrize("first", [0, 1000, 2000])
def test_joining_bricks_with_few_turns_beats_joining_them_in_any_order(first):
    saved = []
    for seed in range(first, first + 100):
        grid = np.random.default_rng(seed).random((8, 8)) < 0.85
        x_joins, y_joins = joins(grid)
        chosen = sum(map(count_turns, circumnavigate(grid, spanning_edges(grid, x_joins, y_joins))))
        nothing = (np.zeros_like(x_joins), np.zeros_like(y_joins))
        plain = sum(map(count_turns, circumnavigate(grid, spanning_edges(grid, *nothing))))
        saved.append(plain - chosen)
    assert np.mean(saved) > 1.0  # both are greedy, so that a single grid may come out either way


def test_critical_points_are_where_the_sweep_line_splits():
    points = critical_points(shapely.geometry.polygon.orient(WITH_HOLE))
    assert sorted(map(tuple, points.tolist())) == [(240.0, 250.0), (350.0, 160.0)]


@pytest.mark.parametrize("angle", np.radians([0.0, 17.0, 45.0, 90.0, 133.0]))
@pytest.mark.parametrize("ground", [WITH_HOLE, U_SHAPE])
def test_cells_tile_the_ground_and_every_line_crosses_them_once(ground, angle):
    turned = shapely.affinity.rotate(ground, angle, use_radians=True)
    parts = cells(shapely.MultiPolygon([turned]))
    assert sum(p.area for p in parts) == pytest.approx(ground.area, rel=1e-6)
    assert shapely.union_all(parts).symmetric_difference(turned).area < 1.0
    for part in parts:
        x0, y0, x1, y1 = part.bounds
        for x in np.linspace(x0, x1, 23)[1:-1]:
            inside = shapely.LineString([(x, y0 - 1), (x, y1 + 1)]).intersection(part)
            assert len([g for g in shapely.get_parts(inside) if g.length > 0.1]) <= 1


def test_a_rectangle_with_a_hole_has_four_cells():
    assert len(cells(shapely.MultiPolygon([WITH_HOLE]))) == 4


def test_cells_are_flown_one_after_the_other_around_a_hole():
    router = Router(make_obstacles(shapely.Polygon(WITH_HOLE.interiors[0]), 2.0))
    field = Field(shapely.MultiPolygon([WITH_HOLE]), router.obstacles)
    legs = bcd_legs(field, 0.0, FOOT, router)
    by_column = column_legs(field, 0.0, FOOT)

    def ways(row):
        return router.each(row[:-1, 1], row[1:, 0]).sum()

    assert len(legs) == len(by_column)
    assert ways(legs) < ways(by_column)


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 5), st.integers(0, 1000))
def test_the_order_of_few_cells_is_the_best(n, seed):
    rng = np.random.default_rng(seed)
    entry, leave = rng.uniform(0, 100, (4 * n, 2)), rng.uniform(0, 100, (4 * n, 2))
    ways = np.hypot(*(leave[:, None] - entry[None]).transpose(2, 0, 1))

    def best_for(row):
        return min(
            sum(ways[4 * a + x, 4 * b + y] for (a, x), (b, y) in itertools.pairwise(zip(row, code, strict=True)))
            for code in itertools.product(range(4), repeat=n)
        )

    order = order_cells(ways)
    assert sorted(k // 4 for k in order) == list(range(n))
    found = sum(ways[a, b] for a, b in itertools.pairwise(order))
    rows = itertools.permutations(range(n)) if n <= 4 else [[k // 4 for k in order]]
    assert found <= min(best_for(row) for row in rows) + 1e-6


def test_the_order_of_many_cells_is_near_the_exact_one():
    rng = np.random.default_rng(2)
    for _ in range(5):
        entry, leave = rng.uniform(0, 100, (4 * 9, 2)), rng.uniform(0, 100, (4 * 9, 2))
        ways = np.hypot(*(leave[:, None] - entry[None]).transpose(2, 0, 1))
        many, few = order_cells(ways), order_cells(ways[: 4 * 8, : 4 * 8])
        assert sorted(k // 4 for k in many) == list(range(9))
        length = [sum(ways[a, b] for a, b in itertools.pairwise(order)) for order in (many, few)]
        assert length[0] < 2.0 * length[1] + 100.0


@pytest.mark.parametrize("lay", ["columns", "bcd", "tmstc"])
def test_lines_of_every_method_see_a_free_area_and_keep_their_distance(lay):
    router = Router(FREE)
    field = Field(shapely.MultiPolygon([U_SHAPE]), FREE)
    if lay == "columns":
        legs = column_legs(field, 0.0, FOOT)
    elif lay == "bcd":
        legs = bcd_legs(field, 0.0, FOOT, router)
    else:
        legs = np.concatenate(tmstc_legs(field, 0.0, FOOT))
    bands = [shapely.LineString(leg).buffer(0.5 * FOOT.width_m, cap_style="flat") for leg in legs]
    assert U_SHAPE.difference(shapely.union_all(bands)).area < 1e-3 * U_SHAPE.area
    upright = np.abs(legs[:, 0, 0] - legs[:, 1, 0]) < 1e-6
    gaps = np.diff(np.unique(np.round(legs[upright][:, 0, 0], 3)))
    assert gaps.max() <= FOOT.spacing_m + 1e-3


def ways(row, depot):
    """Length of the ways between legs, and from and to the depot if there is one."""
    total = np.hypot(*(row[1:, 0] - row[:-1, 1]).T).sum()
    return total if depot is None else total + np.hypot(*(row[0, 0] - depot)) + np.hypot(*(row[-1, 1] - depot))


def scattered(n, seed, with_depot):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 500, (n, 2, 2)), rng.uniform(0, 500, 2) if with_depot else None


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 9), st.integers(0, 1000), st.booleans())
def test_local_search_keeps_all_legs_and_never_lengthens_the_row(n, seed, with_depot):
    legs, depot = scattered(n, seed, with_depot)
    better = shorten(legs, Router(FREE), depot)

    def unordered(row):
        return sorted(sorted(map(tuple, leg.tolist())) for leg in row)

    assert unordered(better) == unordered(legs)
    assert ways(better, depot) <= ways(legs, depot) + 1e-6


def test_local_search_mostly_finds_the_shortest_row():
    """A local search can stop at a row that no single move shortens; that is to be rare, and then near."""
    over = []
    for seed in range(100):
        legs, depot = scattered(4, seed, seed % 2 == 0)
        tried = [
            ways(np.array([legs[k][::-1] if f else legs[k] for k, f in zip(row, flips, strict=True)]), depot)
            for row in itertools.permutations(range(4))
            for flips in itertools.product([False, True], repeat=4)
        ]
        over.append(ways(shorten(legs, Router(FREE), depot), depot) / min(tried) - 1.0)
    assert np.mean(np.array(over) < 1e-6) > 0.8 and np.percentile(over, 95) < 0.15, np.percentile(
        over, [50, 80, 95, 100]
    )
