"""The direction of lines that a user asks for, and lines across these."""

import json

import numpy as np
import pyproj
import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.plans.plan_request import PlanRequest, make_plan
from orthoswarm.model.errors import InputError
from tests.kit.plan_checks import on_globe, write_geojson

BOX = [(0, 0), (600, 0), (600, 300), (0, 300)]
GLOBE = pyproj.Geod(ellps="WGS84")


def planned(folder, shape=BOX, **values):
    area = write_geojson(folder / "area.geojson", on_globe(shape, []))
    return make_plan(PlanRequest(area=area, **{"vehicles": 2, "altitude_m": 60.0, "fov_min_deg": 60.0, **values}))[0]


def headings(plan):
    """True azimuth of each leg, 0 to 180 degrees, and its length in metres."""
    legs = [leg for vehicle in plan.vehicles for sortie in vehicle.sorties for leg in sortie.legs]
    found = [GLOBE.inv(a.lon_deg, a.lat_deg, b.lon_deg, b.lat_deg) for a, b in legs]
    return np.array([azimuth % 180.0 for azimuth, _, _ in found]), np.array([length for _, _, length in found])


def off(azimuths, wanted):
    return np.abs((azimuths - wanted + 90.0) % 180.0 - 90.0)


@pytest.mark.parametrize("method", ["columns", "bcd"])
@pytest.mark.parametrize("heading", [0.0, 37.0, 300.0])
def test_lines_lie_as_asked_from_true_north_and_cover_all(tmp_path, method, heading):
    plan = planned(tmp_path, method=method, heading=heading)
    azimuths, _ = headings(plan)
    assert off(azimuths, heading).max() < 0.05 and plan.covered_share == pytest.approx(1.0)


def test_lines_along_the_wind_and_along_the_longest_side(tmp_path):
    azimuths, _ = headings(planned(tmp_path, heading="wind", wind_m_s=4.0, wind_from_deg=250.0))
    assert off(azimuths, 70.0).max() < 0.05
    tilted = [(0, 0), (500, 250), (400, 450), (-100, 200)]
    free, _ = headings(planned(tmp_path, tilted, heading=5.0))
    azimuths, _ = headings(planned(tmp_path, tilted, heading="longest"))
    along = np.degrees(np.arctan2(500, 250))
    assert off(azimuths, along).max() < 3.0 < off(free, along).max()  # the grid's convergence is less


@pytest.mark.parametrize("method", ["columns", "bcd"])
def test_lines_across_see_all_of_the_area_once_more(tmp_path, method):
    once, twice = (planned(tmp_path, method=method, heading=20.0, cross=cross) for cross in (False, True))
    azimuths, lengths = headings(twice)
    along, across = off(azimuths, 20.0) < 0.05, off(azimuths, 110.0) < 0.05
    assert (along | across).all()
    assert lengths[along].sum() == pytest.approx(headings(once)[1].sum(), rel=0.02)
    lines = planned(tmp_path, method=method, heading=110.0)
    assert lengths[across].sum() == pytest.approx(headings(lines)[1].sum(), rel=0.02)
    free = headings(planned(tmp_path, method=method, cross=True))[0]
    assert sorted(np.unique(np.round(off(free, free[0])))) == [0.0, 90.0]


def test_what_has_its_own_direction_takes_none(tmp_path):
    line = {"type": "LineString", "coordinates": [[9.0, 47.0], [9.01, 47.0]]}
    (tmp_path / "line.geojson").write_text(json.dumps(line))
    request = PlanRequest(area=tmp_path / "line.geojson", vehicles=1, altitude_m=60.0, fov_min_deg=60.0, heading=30.0)
    with pytest.raises(InputError, match="own direction; leave out --heading"):
        make_plan(request)
    with pytest.raises(InputError, match="need one; give it with --wind-m-s"):
        planned(tmp_path, heading="wind")


def test_the_command_takes_a_heading_and_lines_across(tmp_path, capsys):
    area = write_geojson(tmp_path / "area.geojson", on_globe(BOX, []))
    call = ["plan", str(area), "--vehicles", "2", "--altitude", "60", "--fov-min", "60", "--json"]
    photos = []
    for number, flags in enumerate(([], ["--heading", "longest"], ["--heading", "90", "--cross"])):
        assert main([*call, *flags, "--out", str(tmp_path / str(number))]) == 0
        photos.append(sum(vehicle["photos"] for vehicle in json.loads(capsys.readouterr().out)["vehicles"]))
    assert photos[2] > 1.8 * photos[1]
