"""Tracks that are kept for a refinement give what it would have found, and are used for the same pictures only."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.grey_pictures import GreyPictures
from orthoswarm.refine.flight import kept_tracks
from orthoswarm.refine.flight.kept_tracks import KeptTracks
from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions, SwarmRefiner
from orthoswarm.refine.strategy.vehicle_passes import read_frame
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map

EPSG, ORIGIN = 32631, np.array([500_000.0, 5_000_000.0])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Frames of a flight, the map, and the solution without anything kept."""
    folder = tmp_path_factory.mktemp("flight")
    ground = made_up_ground()
    write_map(ground, folder / "map.tif")
    frames, basemap = made_up_flight(ground, folder, "v1"), Basemap.open(folder / "map.tif", EPSG)
    return frames, basemap, values(refined(frames, basemap, RefinerOptions()))


@pytest.fixture
def kept(tmp_path):
    """Options that keep tracks and decoded pictures."""
    return RefinerOptions(read=GreyPictures(tmp_path).gray, kept=KeptTracks(tmp_path))


def refined(frames, basemap, options):
    return SwarmRefiner(EPSG, ORIGIN, options).refine(frames, [], basemap)


def followed(frames, options):
    SwarmRefiner(EPSG, ORIGIN, options).follow(frames)
    return sorted(options.kept.folder.glob("*.tracks"))


def values(solution):
    """All that a solution states, as bytes."""
    placed = [
        (p.frame.image, p.camera.position.tobytes(), p.camera.rotation.tobytes(), p.camera.lens, p.sigma_m)
        for p in solution.placed
    ]
    return placed, solution.dropped, solution.legs, solution.warnings, solution.terrain.z.tobytes()


def test_kept_tracks_give_the_same_solution_without_reading_pictures_for_them(scene, kept):
    frames, basemap, alone = scene
    (file,) = followed(frames, kept)
    read = []
    counted = replace(kept, read=lambda frame: read.append(frame.image) or kept.read(frame))
    assert followed(frames, counted) == [file]
    assert read == []
    assert values(refined(frames, basemap, kept)) == alone


def test_pictures_that_cannot_be_read_are_remembered(tmp_path, scene, kept):
    frames, basemap, _ = scene
    torn = tmp_path / "torn.jpg"
    torn.write_bytes(frames[6].path.read_bytes()[:400])
    some = [*frames[:6], replace(frames[6], path=torn), *frames[7:]]
    followed(some, kept)
    assert values(refined(some, basemap, kept)) == values(refined(some, basemap, RefinerOptions()))


@pytest.mark.parametrize("change", ["record", "left out", "late", "picture"])
def test_tracks_of_other_frames_are_not_used(tmp_path, scene, kept, change):
    frames, basemap, _ = scene
    earlier = now = frames
    if change == "record":
        other = replace(frames[5].fix, yaw_rad=frames[5].fix.yaw_rad + 0.05)
        now = [*frames[:5], replace(frames[5], fix=other), *frames[6:]]
    elif change == "left out":
        now = [*frames[:9], *frames[10:]]
    elif change == "late":
        earlier = frames[:-1]
    else:
        copy = tmp_path / "copy.jpg"
        shutil.copy(frames[3].path, copy)
        earlier = now = [*frames[:3], replace(frames[3], path=copy), *frames[4:]]
    kept = replace(kept, read=read_frame)  # a store of grey pictures is for files that do not change
    (before,) = followed(earlier, kept)
    if change == "picture":
        cv2.imwrite(str(copy), cv2.imread(str(copy))[::-1])
    assert len(followed(now, kept)) == 2
    before.write_bytes(b"of another time")
    assert values(refined(now, basemap, kept)) == values(refined(now, basemap, RefinerOptions()))


def test_what_is_damaged_or_gone_is_made_again(scene, kept):
    frames, basemap, alone = scene
    (file,) = followed(frames, kept)
    file.write_bytes(file.read_bytes()[:1000])
    assert values(refined(frames, basemap, kept)) == alone
    assert file.stat().st_size > 1000
    shutil.rmtree(kept.kept.folder)
    assert values(refined(frames, basemap, kept)) == alone


def test_only_the_last_few_tracks_stay(scene, kept, monkeypatch):
    frames, _, _ = scene
    monkeypatch.setattr(kept_tracks, "_MOST_KEPT", 2)
    first = followed(frames[:22], kept)
    second = followed(frames[:24], kept)
    third = followed(frames, kept)
    assert (len(first), len(second), len(third)) == (1, 2, 2)
    assert not first[0].exists()
    assert set(second) & set(third)
