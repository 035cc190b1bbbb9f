"""Corners are followed through turns, light and many pictures, and never invented."""

import cv2
import numpy as np
import pytest

from orthoswarm.model.camera import rotation_from_angles
from orthoswarm.refine.features.tracks import CELL_PX, Tracker, predicted_homography


@pytest.fixture(scope="module")
def ground():
    rng = np.random.default_rng(3)
    noise = sum(
        cv2.resize(rng.random((1600 // s, 1600 // s)).astype(np.float32), (1600, 1600), interpolation=cv2.INTER_CUBIC)
        for s in (4, 8, 25, 80)
    )
    return cv2.normalize(noise, None, 10, 245, cv2.NORM_MINMAX).astype(np.uint8)


def view(ground, matrix):
    """The picture (640 x 480) whose pixel p shows ground pixel matrix @ p."""
    return cv2.warpPerspective(ground, matrix, (640, 480), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def placed(angle, x, y, scale=1.0):
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return np.array([[c, -s, x - 320 * c + 240 * s], [s, c, y - 320 * s - 240 * c], [0, 0, 1.0]])


def error_of(tracker, matrices):
    tracks = tracker.tracks()
    where = np.array([m @ [*uv, 1] for m, uv in zip([matrices[c] for c in tracks.camera], tracks.uv, strict=True)])[
        :, :2
    ]
    mean = np.array([np.bincount(tracks.point, where[:, a]) for a in range(2)]).T / np.bincount(tracks.point)[:, None]
    return tracks, np.hypot(*(where - mean[tracks.point]).T)


def follow(ground, matrices, wrong=(2.0, -1.5), gain=None, cell_px=CELL_PX):
    tracker = Tracker(cell_px=cell_px)
    shares = []
    for i, m in enumerate(matrices):
        picture = view(ground, m)
        if gain is not None:
            picture = np.clip(picture * gain(i) + 4 * i, 0, 255).astype(np.uint8)
        predicted = None
        if i:
            predicted = np.array([[1, 0, wrong[0]], [0, 1, wrong[1]], [0, 0, 1.0]]) @ np.linalg.inv(m) @ matrices[i - 1]
        shares.append(tracker.add(i, picture, predicted))
    return tracker, shares


def test_a_straight_leg_is_followed_to_a_tenth_of_a_pixel_without_drift(ground):
    matrices = [placed(0.02 * i / 30, 420 + 16.3 * i, 700) for i in range(30)]
    tracker, shares = follow(ground, matrices)
    tracks, error = error_of(tracker, matrices)
    assert np.median(shares[1:]) > 0.8
    assert np.median(error) < 0.1
    first = np.full(tracks.count, 99)
    np.minimum.at(first, tracks.point, tracks.camera)
    assert np.median(error[tracks.camera - first[tracks.point] >= 12]) < 0.15


def test_a_right_angle_turn_between_two_pictures_is_survived(ground):
    matrices = [placed(0.0, 700, 700), placed(0.0, 712, 700), placed(np.pi / 2, 724, 706), placed(np.pi / 2, 724, 718)]
    tracker, shares = follow(ground, matrices)
    assert shares[2] > 0.4
    _, error = error_of(tracker, matrices)
    assert np.median(error) < 0.15


def test_brightness_may_change(ground):
    matrices = [placed(0.0, 500 + 12 * i, 700) for i in range(6)]
    tracker, shares = follow(ground, matrices, gain=lambda i: 1.0 - 0.06 * i)
    assert min(shares[1:]) > 0.6
    assert np.median(error_of(tracker, matrices)[1]) < 0.1


def test_a_far_off_prediction_is_rescued_by_the_whole_picture(ground):
    matrices = [placed(0.0, 500 + 12 * i, 700) for i in range(4)]
    tracker, shares = follow(ground, matrices, wrong=(37.0, 22.0))
    assert min(shares[1:]) > 0.5
    assert np.median(error_of(tracker, matrices)[1]) < 0.15


def test_angles_that_are_wrong_by_degrees_do_not_end_tracks(ground):
    """As of a camera that sways and whose angles were recorded late: 3 degrees each way, once 15 in the heading."""
    rng = np.random.default_rng(2)
    matrices = [placed(0.05 * np.sin(i), 420 + 16.3 * i, 700) for i in range(30)]
    tracker, shares = Tracker(), []
    for i, m in enumerate(matrices):
        turned = placed(
            np.radians(15.0 if i == 12 else rng.normal(0, 3.0)), *(np.array([320, 240]) + rng.normal(0, 17, 2))
        )
        predicted = turned @ np.linalg.inv(m) @ matrices[i - 1] if i else None
        shares.append(tracker.add(i, view(ground, m), predicted))
    tracks, error = error_of(tracker, matrices)
    assert min(shares[1:]) > 0.6
    assert np.median(error) < 0.15
    assert np.bincount(tracks.point).mean() > 8  # as with right angles


def test_a_turn_that_nobody_recorded_is_survived(ground):
    turns = [0.0, 0.0, 0.9, 2.5, 2.5]
    matrices = [placed(turn, 700 + 12 * i, 700) for i, turn in enumerate(turns)]
    tracker = Tracker()
    shares = [tracker.add(i, view(ground, m), np.eye(3) if i else None) for i, m in enumerate(matrices)]
    assert min(shares[1:]) > 0.4
    _, error = error_of(tracker, matrices)
    assert np.median(error) < 0.15


def test_pictures_of_different_ground_are_not_followed(ground):
    tracker = Tracker()
    tracker.add(0, view(ground, placed(0.0, 500, 500)), None)
    assert tracker.add(1, view(ground, placed(0.0, 1200, 1200)), np.eye(3)) < 0.3  # some corners look alike


def test_a_handful_of_corners_that_agree_by_chance_is_no_track(ground):
    """Of pictures of different ground none is followed: a few would pull both places together."""
    rng = np.random.default_rng(5)
    for _ in range(25):
        tracker = Tracker()
        first, second = rng.uniform(400, 450, 2), rng.uniform(1120, 1200, 2)
        tracker.add(0, view(ground, placed(rng.uniform(0, 6), *first)), None)
        shift = np.array([[1, 0, rng.uniform(-200, 200)], [0, 1, rng.uniform(-150, 150)], [0, 0, 1.0]])
        assert tracker.add(1, view(ground, placed(rng.uniform(0, 6), *second)), shift) == 0.0


def test_there_is_at_most_one_track_in_a_cell(ground):
    matrices = [placed(0.0, 500 + 20 * i, 700) for i in range(8)]
    tracker, _ = follow(ground, matrices)
    tracks = tracker.tracks()
    cells = np.column_stack([np.floor(tracks.uv / tracker.cell_px).astype(int), tracks.camera])
    assert len(cells) > 200
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_cells_are_as_large_as_asked_for(ground):
    matrices = [placed(0.0, 500 + 20 * i, 700) for i in range(4)]
    usual, _ = follow(ground, matrices)
    wide, _ = follow(ground, matrices, cell_px=160)
    assert wide.tracks().count < 0.4 * usual.tracks().count


def test_a_blank_picture_gives_nothing_and_breaks_nothing():
    tracker = Tracker()
    for i in range(3):
        tracker.add(i, np.full((480, 640), 128, np.uint8), np.eye(3) if i else None)
    assert tracker.tracks().count == 0


def test_the_predicted_homography_is_that_of_flat_ground():
    matrix = np.array([[300, 0, 319.5], [0, 300, 239.5], [0, 0, 1.0]])
    a = rotation_from_angles(0.3, -1.5, 0.05)
    b = rotation_from_angles(0.5, -1.6, -0.02)
    step = np.array([7.0, -3.0, 0.8])
    h = predicted_homography(a, b, 120.0, step, matrix)
    ground = np.array([11.0, 25.0, -120.0])
    before, after = matrix @ a.T @ ground, matrix @ b.T @ (ground - step)
    moved = h @ before
    np.testing.assert_allclose(moved[:2] / moved[2], after[:2] / after[2], atol=1e-9)
