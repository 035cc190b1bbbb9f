"""The headline of a report: how good the map is, what was checked, and where it is only for orientation."""

import pytest

from orthoswarm.report.trust import headline, sentences

TRUST = {
    "good_to_m": {"0.2": 0.4, "0.5": 0.6, "2": 0.9},
    "whole_good_to_m": 0.0,
    "doubtful_sides": ["east"],
    "leaning_share": 0.2,
    "single_picture_share": 0.01,
}


def said(report=(), **trust):
    return headline({"trust": TRUST | trust, "basemap": "map.tif", "checkpoints": None, "control": None} | dict(report))


def test_on_a_map():
    assert said() == (
        "Places lie within about 50 cm of the pre-disaster map; absolute position not checked; "
        "the east edge and what stands high only for orientation."
    )


def test_without_a_map_the_place_of_the_whole_is_said_apart():
    assert said({"basemap": None}, whole_good_to_m=4.3, doubtful_sides=[], leaning_share=0.0) == (
        "Distances are good to about 50 cm; the whole map lies within about 5 m of where the receivers say."
    )


def test_what_was_checked_is_said():
    assert "checked at surveyed points: 0.12 m (RMSE)" in said({"checkpoints": {"rmse_h_m": 0.12}})
    assert "placed on surveyed points, and not checked" in said({"control": {"points": 4}})


@pytest.mark.parametrize(
    ("sides", "words"),
    [(["north", "east"], "the north and east edges"), (["north", "east", "south", "west"], "the edges")],
)
def test_edges_are_named(sides, words):
    assert f"; {words} and what stands high only" in said(doubtful_sides=sides)


def test_a_map_of_recorded_poses_is_for_orientation():
    assert said(good_to_m={"0.2": 0.0, "0.5": 0.0, "2": 0.0}) == "For orientation only; absolute position not checked."


def test_shares_are_said_below_the_picture():
    assert sentences({"trust": TRUST}).startswith(
        "Of the map are good: 40% to 20 cm, 60% to 50 cm, 90% to 2 m or better; 10%"
    )
