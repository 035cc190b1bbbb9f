"""Whole plans, judged by flying their mission files with code of the tests."""

import itertools

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from benchmarks.robustness.late_vehicles import CORNER, flown_tracks, left_over, met, plans_of
from gcs_plugin.plans.plan_files import mission_files
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.planning.area.area import Area, make_area
from orthoswarm.planning.lines.detours import Router, make_obstacles
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.planner import plan_area, plan_lines
from orthoswarm.planning.sorties.assignment import PlanOptions
from orthoswarm.planning.sorties.deconfliction import Separation
from orthoswarm.planning.sorties.flight_time import Motion
from tests.kit.plan_checks import GRID, ORIGIN, crossed, fly, on_globe, seen_by, to_metres

METHODS = ["columns", "bcd", "tmstc"]
CONCAVE = [(0, 0), (900, 0), (900, 700), (600, 700), (600, 300), (300, 300), (300, 700), (0, 700)]
HOLE = [(700, 350), (820, 380), (800, 520), (690, 480)]


def start_at(x, y):
    lat, lon = GRID.to_geographic(ORIGIN + np.array([x, y]))
    return float(lat), float(lon)


def flown(plan, autopilot="ardupilot"):
    texts = mission_files(plan, [autopilot])
    return {name: fly(text) for name, text in texts.items() if name.endswith(".waypoints")}


def covered(plan, shell, holes, foot):
    ground = shapely.Polygon(shell, holes)
    seen = shapely.union_all([seen_by(f, foot.width_m, foot.height_m) for f in flown(plan).values()])
    return ground.intersection(seen).area / ground.area


@st.composite
def star_polygons(draw):
    """A star-shaped outline about the origin with a radius in metres, and up to two holes in it."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    radius = draw(st.sampled_from([60.0, 200.0, 700.0]))

    def star(corners, size, centre):
        gaps = rng.uniform(0.4, 1.0, corners)
        angles = rng.uniform(0, 7) + np.cumsum(gaps) / gaps.sum() * 2 * np.pi
        lengths = size * rng.uniform(0.4, 1.0, corners)
        return centre + lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)

    shell = star(draw(st.integers(4, 11)), radius, np.zeros(2))
    outline, holes = shapely.Polygon(shell), []
    for _ in range(draw(st.integers(0, 2))):
        hole = star(draw(st.integers(3, 7)), rng.uniform(0.06, 0.25) * radius, rng.uniform(-0.4, 0.4, 2) * radius)
        body = shapely.Polygon(hole)
        apart = all(body.distance(shapely.Polygon(other)) > 5 for other in holes)
        if body.is_valid and outline.buffer(-3).contains(body) and apart:
            holes.append(hole)
    assume(outline.is_valid and outline.area > 0.3 * radius**2)
    return shell, holes, radius


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    star_polygons(),
    st.sampled_from(METHODS),
    st.sampled_from([1, 2, 3, 5, 8]),
    st.floats(0.05, 0.25),
    st.floats(35.0, 100.0),
    st.booleans(),
    st.sampled_from(["rtl", "land", "hover"]),
)
def test_any_area_is_seen_without_crossing_holes_and_shared_evenly(shape, method, vehicles, height, fov, near, end):
    shell, holes, radius = shape
    foot = footprint(height * radius, np.radians(fov))
    starts = [start_at(1.3 * radius, 0.0)] if near else []
    try:
        plan = plan_area(
            make_area([on_globe(shell, holes)]),
            vehicles,
            height * radius,
            foot,
            method=method,
            options=PlanOptions(end=end, starts=starts),
        )
    except InputError as error:
        assert "lines" in str(error) and vehicles > 1
        return
    share = covered(plan, shell, holes, foot)
    assert share >= 0.999
    assert abs(share - plan.covered_share) < 1e-3
    missions = flown(plan)
    assert len(missions) == sum(len(v.sorties) for v in plan.vehicles)
    for mission in missions.values():
        assert crossed(mission, holes) < 1e-3
    legs = sum(len(m.legs) for m in missions.values())
    if legs >= 3 * vehicles:
        assert plan.balance <= 1.25
        lengths = [sum(m.length_m for n, m in missions.items() if n.split(".")[0] == v.id) for v in plan.vehicles]
        assert max(lengths) <= 1.25 * np.mean(lengths)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("vehicles", [1, 8])
def test_a_concave_area_with_a_hole_is_done_by_every_method(method, vehicles):
    foot = footprint(60.0, np.radians(60.0))
    plan = plan_area(make_area([on_globe(CONCAVE, [HOLE])]), vehicles, 60.0, foot, method=method)
    assert plan.covered_share >= 0.999 and not plan.warnings
    assert covered(plan, CONCAVE, [HOLE], foot) >= 0.999
    assert plan.balance <= 1.2
    assert plan.makespan_s == max(v.time_s for v in plan.vehicles)
    photos = 0
    for mission in flown(plan).values():
        assert crossed(mission, [HOLE]) == 0.0
        lengths = [np.hypot(*(b - a)) for a, b in mission.legs]
        photos += sum(int(n / d + 1e-6) + 1 for n, d in zip(lengths, mission.distances, strict=True))
    assert sum(v.photos for v in plan.vehicles) == photos


def test_pictures_lie_across_legs_at_the_planned_overlap():
    foot = footprint(100.0, np.radians(60.0), aspect=1.5, side=0.3, forward=0.7)
    assert foot.width_m == pytest.approx(2 * 100 * np.tan(np.radians(30)))
    assert foot.height_m == pytest.approx(foot.width_m / 1.5)
    plan = plan_area(make_area([on_globe([(0, 0), (600, 0), (600, 500), (0, 500)])]), 1, 100.0, foot, method="columns")
    (mission,) = flown(plan).values()
    assert set(np.round(mission.distances, 4)) == {round(0.3 * foot.height_m, 4)}
    at = sorted(leg[0][0] for leg in mission.legs)
    if np.ptp(at) < 1:  # lines along x
        at = sorted(leg[0][1] for leg in mission.legs)
    assert np.diff(at).max() <= 0.7 * foot.width_m + 1e-6


def test_little_forward_overlap_lengthens_legs_so_that_their_ends_are_seen():
    foot = footprint(60.0, np.radians(60.0), forward=0.1)
    shell = [(0, 0), (503, 0), (503, 407), (0, 407)]
    plan = plan_area(make_area([on_globe(shell)]), 2, 60.0, foot)
    assert covered(plan, shell, [], foot) >= 0.999


@pytest.mark.parametrize("method", METHODS)
def test_a_small_area_gets_one_short_leg(method):
    shell = [(0, 0), (12, 0), (12, 9), (0, 9)]
    foot = footprint(80.0, np.radians(60.0))
    plan = plan_area(make_area([on_globe(shell)]), 1, 80.0, foot, method=method)
    (mission,) = flown(plan).values()
    assert len(mission.legs) == 1 and covered(plan, shell, [], foot) == pytest.approx(1.0)


def test_parts_of_an_area_are_all_flown():
    left, right = [(0, 0), (200, 0), (200, 300), (0, 300)], [(500, 100), (700, 100), (700, 400), (500, 400)]
    foot = footprint(60.0, np.radians(60.0))
    for method in METHODS:
        plan = plan_area(make_area([on_globe(left), on_globe(right)]), 3, 60.0, foot, method=method)
        for shell in (left, right):
            assert covered(plan, shell, [], foot) >= 0.999


def test_what_cannot_be_seen_is_listed_as_gaps():
    # A no-fly zone of 400 m with a slit of ground 3 m wide and 300 m deep into it: nobody may fly in there.
    slit = [(-300, -300), (300, -300), (300, 300), (1.5, 300), (1.5, 0), (-1.5, 0), (-1.5, 300), (-300, 300)]
    shell = [(-500, -500), (500, -500), (500, 500), (-500, 500)]
    foot = footprint(30.0, np.radians(40.0))
    plan = plan_area(make_area([on_globe(shell, [slit])]), 2, 30.0, foot, options=PlanOptions(clearance_m=2.0))
    gap = plan.gaps[0]
    x, y = to_metres([(gap.lat_deg, gap.lon_deg)])[0]
    assert abs(x) < 2 and 0 < y < 300
    assert gap.area_m2 == pytest.approx(3 * 290, rel=0.1)
    missing = sum(g.area_m2 for g in plan.gaps)
    assert 1 - plan.covered_share == pytest.approx(missing / plan.area_m2, rel=0.05)
    assert plan.covered_share < 0.999 and any("not complete" in w for w in plan.warnings)


def test_sorties_keep_within_the_endurance_and_resume_where_the_last_one_stopped():
    foot, motion = footprint(60.0, np.radians(60.0)), Motion()
    start = start_at(-50.0, -50.0)
    options = PlanOptions(starts=[start], endurance_s=9 * 60.0)
    plan = plan_area(make_area([on_globe(CONCAVE, [HOLE])]), 2, 60.0, foot, method="columns", options=options)
    assert covered(plan, CONCAVE, [HOLE], foot) >= 0.999
    for vehicle in plan.vehicles:
        assert len(vehicle.sorties) > 1
        for before, after in itertools.pairwise(vehicle.sorties):
            assert after.start_s >= before.start_s + before.time_s + options.separation.swap_s - 1e-6
        lines = [to_metres([(w.lat_deg, w.lon_deg) for w in pair]) for s in vehicle.sorties for pair in s.legs]
        ends = np.array([s.legs[-1][1].lat_deg for s in vehicle.sorties[:-1]])
        starts = np.array([s.legs[0][0].lat_deg for s in vehicle.sorties[1:]])
        assert len(lines) >= len(vehicle.sorties)
        assert (np.abs(ends - starts) < 1e-3).all()
        for sortie in vehicle.sorties:
            assert sortie.time_s <= options.endurance_s
            straight = sortie.length_m / motion.speed_m_s
            assert sortie.time_s > straight  # turns, climb and descent cost time
            assert (sortie.home_lat_deg, sortie.home_lon_deg) == pytest.approx(start, abs=1e-7)


def test_an_endurance_that_cannot_reach_the_far_end_is_refused_with_what_it_takes():
    options = PlanOptions(starts=[start_at(-50.0, -50.0)], endurance_s=180.0)
    with pytest.raises(InputError, match=r"endurance of 3\.0 min is too short: .* needs about \d"):
        plan_area(make_area([on_globe(CONCAVE)]), 2, 60.0, footprint(60.0, np.radians(60.0)), options=options)


def test_a_mission_never_holds_more_items_than_the_autopilot():
    foot = footprint(10.0, np.radians(50.0))
    shell = [(0, 0), (700, 0), (700, 60), (0, 60)]
    options = PlanOptions(most_items=60)
    plan = plan_area(make_area([on_globe(shell)]), 1, 10.0, foot, method="columns", options=options)
    assert len(plan.vehicles[0].sorties) > 1 and any("60 items" in w for w in plan.warnings)
    for text in mission_files(plan, ["ardupilot"]).values():
        if text.startswith("QGC"):
            assert len(text.splitlines()) - 1 <= 60
    assert covered(plan, shell, [], foot) >= 0.999


def positions(plan, sortie, motion, step=0.25):
    """Where a vehicle is every so often, from its waypoints alone: (n, 4) time, x, y, height."""
    points = [(sortie.home_lat_deg, sortie.home_lon_deg), *((w.lat_deg, w.lon_deg) for w in sortie.waypoints)]
    at = to_metres([points[0], points[0], *points[1:]])
    heights = [0.0, sortie.takeoff_height_m, *(w.height_m for w in sortie.waypoints)]
    path = np.column_stack([at, heights])
    if plan.end != "hover":
        path = np.vstack([path, [*path[0, :2], 0.0]])
    times, path = motion.course(path)
    times += sortie.start_s
    moments = np.arange(0, times[-1], step)
    return moments, np.stack([np.interp(moments, times, path[:, k]) for k in range(3)], 1), times[0]


@pytest.mark.parametrize(("method", "vehicles", "start"), [("columns", 6, True), ("tmstc", 9, False), ("bcd", 8, True)])
def test_vehicles_stay_apart_even_off_schedule(method, vehicles, start):
    foot, apart = footprint(60.0, np.radians(60.0)), Separation(distance_m=12.0, height_m=4.0, slack_s=2.0)
    options = PlanOptions(starts=[start_at(-60.0, 200.0)] if start else [], separation=apart)
    plan = plan_area(make_area([on_globe(CONCAVE, [HOLE])]), vehicles, 60.0, foot, method=method, options=options)
    tracks = [positions(plan, v.sorties[0], options.motion) for v in plan.vehicles]
    met = 0
    for (a, b), late in itertools.product(itertools.combinations(range(vehicles), 2), (-2.0, 0.0, 2.0)):
        (ta, pa, begin_a), (tb, pb, begin_b) = tracks[a], tracks[b]
        n = min(len(pa), len(pb))
        shift = int(late / 0.25)
        i = np.arange(max(0, -shift), min(n, n - shift))
        p, q = pa[i], pb[i + shift]
        flying = (ta[i] > begin_a) & (tb[i + shift] > begin_b) & (p[:, 2] > 2) & (q[:, 2] > 2)
        distance = np.hypot(*(p[:, :2] - q[:, :2]).T)
        pads = (np.hypot(*(p[:, :2] - pa[0, :2]).T) < 18) & (np.hypot(*(q[:, :2] - pb[0, :2]).T) < 18)
        close = flying & ~pads & (distance < 12.0) & (np.abs(p[:, 2] - q[:, 2]) < 3.98)
        assert not close.any(), (a, b, late, distance[close].min())
        met += int((flying & (distance < 60)).sum())
    assert met > 0
    assert "12 m apart" in plan.separation
    if start:
        begins = sorted(v.sorties[0].start_s for v in plan.vehicles)
        assert np.diff(begins).min() >= apart.launch_s - 1e-6


@pytest.mark.slow
def test_many_vehicles_share_a_large_area():
    side = 3163.0
    plan = plan_area(
        make_area([on_globe([(0, 0), (side, 0), (side, side), (0, side)], [[(x + 900, y + 900) for x, y in HOLE]])]),
        96,
        100.0,
        footprint(100.0, np.radians(60.0)),
    )
    assert plan.covered_share >= 0.999 and plan.balance <= 1.25
    assert plan.makespan_s < 420


def test_starts_are_given_to_the_vehicles_in_turn_and_each_works_near_its_own():
    starts = [start_at(-30.0, 0.0), start_at(2030.0, 0.0)]
    foot = footprint(60.0, np.radians(60.0))
    area = make_area([on_globe([(0, 0), (2000, 0), (2000, 300), (0, 300)])])
    plan = plan_area(area, 4, 60.0, foot, options=PlanOptions(starts=starts))
    for number, vehicle in enumerate(plan.vehicles):
        (sortie,) = vehicle.sorties
        assert (sortie.home_lat_deg, sortie.home_lon_deg) == pytest.approx(starts[number % 2], abs=1e-7)
        middle = to_metres([(w.lat_deg, w.lon_deg) for leg in sortie.legs for w in leg])[:, 0].mean()
        assert (middle < 1000) == (number % 2 == 0)


@pytest.mark.parametrize(
    ("vehicles", "start", "word"),
    [
        (40, None, "more than this area has lines for"),
        (0, None, "1 to 250"),
        (2, (750, 450), "no-fly"),
        (2, (9e5, 0), "km"),
    ],
)
def test_impossible_swarms_are_refused(vehicles, start, word):
    options = PlanOptions(starts=[start_at(*start)] if start else [])
    with pytest.raises(InputError, match=word):
        plan_area(
            make_area([on_globe(CONCAVE, [HOLE])]), vehicles, 100.0, footprint(100.0, np.radians(60.0)), options=options
        )


@pytest.mark.parametrize(
    ("altitude", "fov", "more"),
    [
        (0, 60, {}),
        (-3, 60, {}),
        (np.nan, 60, {}),
        (50, 9.9, {}),
        (50, 150.1, {}),
        (50, np.nan, {}),
        (50, 60, {"side": 1.0}),
        (50, 60, {"forward": -0.1}),
        (50, 60, {"aspect": 0.0}),
    ],
)
def test_impossible_cameras_are_refused(altitude, fov, more):
    with pytest.raises(InputError):
        footprint(altitude, np.radians(fov), **more)


def test_lines_become_legs_and_short_stretches_turns():
    line = GRID.to_geographic(ORIGIN + np.array([(0, 0), (400, 0), (400, 15), (0, 15), (0, 30), (400, 30)], float))
    foot = footprint(60.0, np.radians(60.0))
    plan = plan_lines([line], 1, 60.0, foot)
    (mission,) = flown(plan).values()
    assert np.allclose(mission.legs, [[(0, 0), (400, 0)], [(400, 15), (0, 15)], [(0, 30), (400, 30)]], atol=0.02)
    assert plan.covered_share is None
    shared = plan_lines([line], 3, 60.0, foot)
    assert sum(len(m.legs) for m in flown(shared).values()) >= 3 and shared.balance < 1.25


def test_a_line_through_a_no_fly_zone_is_refused():
    line = GRID.to_geographic(ORIGIN + np.array([(0, 400), (900, 400)], float))
    area = make_area([on_globe(CONCAVE, [HOLE])])
    with pytest.raises(InputError, match="crosses a no-fly zone"):
        plan_lines([line], 1, 60.0, footprint(60.0, np.radians(60.0)), no_fly=area)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32))
def test_ways_around_zones_are_free_and_as_short_as_a_dense_search_finds(seed):
    rng = np.random.default_rng(seed)
    zones = shapely.union_all(
        [shapely.Point(rng.uniform(0, 100, 2)).buffer(rng.uniform(4, 18), quad_segs=2) for _ in range(4)]
    )
    router = Router(make_obstacles(zones, 1.0))
    points = [p for p in rng.uniform(-10, 110, (12, 2)) if not router.inside(p[None])[0]][:4]
    for p, q in itertools.combinations(points, 2):
        path = router.path(p, q)
        assert shapely.LineString(path).intersection(zones).length == 0.0
        length = np.hypot(*np.diff(path, axis=0).T).sum()
        assert length == pytest.approx(router.distances(p, q)[0, 0])
        assert length >= np.hypot(*(q - p)) - 1e-9
        # No detour over one or two of many other points is shorter.
        others = rng.uniform(-20, 120, (150, 2))
        first = np.hypot(*(others - p).T) + np.where(router.blocked(np.tile(p, (150, 1)), others), np.inf, 0)
        last = np.hypot(*(others - q).T) + np.where(router.blocked(others, np.tile(q, (150, 1))), np.inf, 0)
        assert length <= (first + last).min() + 1e-4  # a detour may graze a zone by as much


@pytest.mark.slow
def test_flights_that_the_first_cut_makes_too_long_are_cut_again_until_they_keep_the_endurance():
    """Between many zones turns and detours are most of a flight, and the cut knows them only roughly."""

    def zone(i, j):
        radius, corners = 30 + (7 * i + 3 * j) % 20, 7 + (i + j) % 4
        angles = 2.0 * np.pi * np.arange(corners) / corners
        return np.stack([100 + 150 * i + radius * np.cos(angles), 100 + 150 * j + radius * np.sin(angles)], 1)

    holes = [zone(i, j) for i in range(5) for j in range(5)]
    area = make_area([on_globe([(0, 0), (800, 0), (800, 800), (0, 800)], holes)])
    start = tuple(on_globe([(-50.0, -50.0)]).shell[0])
    options = PlanOptions(starts=[start], endurance_s=660.0, clearance_m=10.0)
    plan = plan_area(area, 4, 40.0, footprint(40.0, np.radians(60.0)), method="columns", options=options)
    assert plan.covered_share >= 0.999
    assert max(sortie.time_s for vehicle in plan.vehicles for sortie in vehicle.sorties) <= 660.0


@pytest.mark.parametrize("kinds", [["ardupilot"], ["ardupilot", "px4"]])
def test_vehicles_that_fly_as_real_autopilots_do_not_meet(kinds):
    grid = LocalGrid(32632)
    start = tuple(grid.to_geographic(CORNER + np.array([-20.0, 300.0])).tolist())
    corners = [(0, 0), (600, 0), (600, 600), (0, 600)]
    area = Area(grid, shapely.Polygon([CORNER + np.array(c) for c in corners]), shapely.MultiPolygon())
    names = [kinds[k % len(kinds)] for k in range(16)]

    def meetings(options):
        plan = plan_area(area, 16, 60.0, footprint(60.0, np.radians(75.0)), options=options)
        homes = [(v.sorties[0].home_lat_deg, v.sorties[0].home_lon_deg) for v in plan.vehicles]
        places = grid.to_grid(*np.array(homes).T) - CORNER
        left = [left_over(names, np.random.default_rng(seed)) for seed in range(3)]
        return sum(met(flown_tracks(plan, names, seconds), places)[0] for seconds in left)

    plans = plans_of(kinds, [start])
    if len(kinds) > 1:  # else all are late together
        assert meetings(plans[0][1]) > 0  # so the flights do cross
    assert meetings(plans[-1][1]) == 0
