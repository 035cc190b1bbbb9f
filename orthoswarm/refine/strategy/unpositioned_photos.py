"""Photos without a recorded position (kites, old cameras, lost tags), placed by what they show.

The pictures tell how the photos lie to each other (`free_network`); surveyed points, the basemap and the positions of
other photos tell where on the ground. The result is a position and heading with a sigma, as a receiver's, for the
refiner to adjust.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from orthoswarm.evaluation.checkpoints import SURVEY_SIGMA_M, Checkpoint
from orthoswarm.evaluation.photo_names import photo_named
from orthoswarm.model.arrays import Array, Ints
from orthoswarm.model.camera import angles_from_rotation
from orthoswarm.model.frame import BY_OTHERS, ON_MAP, SURVEYED, Frame
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.model.task_runner import Progress, Run
from orthoswarm.refine.features.working_pictures import ReadGray
from orthoswarm.refine.flight.sparse_start import read_photo_records
from orthoswarm.refine.initial.free_network import (
    FREE_PAIR_SHARE,
    Anchors,
    FreeNetwork,
    solve_free_network,
)
from orthoswarm.refine.initial.heading import components
from orthoswarm.refine.initial.initial_orientation import shape_of
from orthoswarm.refine.initial.pair_graph import PairGraphBuilder
from orthoswarm.refine.initial.planar_similarity import PairGraph, PhotoRecords, rotation_of
from orthoswarm.refine.initial.relative_scale import focal_by_hint
from orthoswarm.refine.initial.tilt_and_lens import PairMatches, TiltAndLens, level_pixels, similarities, spaced
from orthoswarm.refine.registration.photos_on_map import FoundMarks, SearchedMap, marks_on_map

_FREE_NADIR_SHARE: Final = 0.05
"""The ground straight below such a photo lies so far from where its level picture has it, sigma as a share of its
width: tilts of three degrees at a field of view of 60."""
_FREE_MOST_PAIRS: Final = 40_000  # most pairs tried where nothing tells overlaps: 280 photos, two minutes of CPU


_ANYWHERE_DEG: Final = (0.0, 3.0)  # latitude, longitude: on a central meridian, where north is up
_ANYWHERE_M: Final = 100.0  # ground in a photo: usual, which is what later stages look for

_MAP_MOST_PHOTOS: Final = 60  # photos that are looked for on the basemap: a second of CPU each
_MAP_MOST_MARKS: Final = 10  # places that each of those found gives to the network (chosen)
_MOVED_SHARE: Final = 0.1
"""Pictures that shift by more of their width from one to the next were not taken at one spot: that is 14 % of the
height or so, and vehicles count as hovering up to 5 %."""
_MOVED_PAIRS: Final = (3, 12)  # fewest pairs that show it, and most that are matched (time)
_LEVEL_PITCH_RAD: Final = -1.05  # a camera that looks farther ahead may turn at its spot


class PlacedPhotos(NamedTuple):
    """Photos with the positions that were found, and images that show ground in common but could not be placed."""

    frames: list[Frame]
    left: list[list[str]]


def place_unpositioned(
    photos: Sequence[Frame],
    positioned: Sequence[Frame],
    points: Sequence[Checkpoint],
    *,
    searched: SearchedMap | None = None,
    anywhere: bool = False,
    read_gray: ReadGray,
    run: Run,
    progress: Progress | None = None,
) -> PlacedPhotos:
    """Give photos the positions and angles that surveyed points, the basemap and other photos tell.

    photos: without positions (their latitude and longitude are NaN), of a vehicle in order of time. positioned: photos
    with positions, which may show the same ground. points: surveyed, with their marks in photos of either kind.
    searched: where photos are looked for on the basemap. anywhere: nothing tells where they lie; the largest part of
    those that show ground in common is put at an arbitrary place, in an arbitrary size and direction.
    """
    places = np.array([_ANYWHERE_DEG]) if anywhere else _known_places(positioned, points, searched)
    if not photos or not len(places):
        return PlacedPhotos([], [])
    grid = LocalGrid(area_epsg(places[:, 0], places[:, 1]) if searched is None else searched.basemap.epsg)
    middle = places[int(np.argmin(((places - np.median(places, axis=0)) ** 2).sum(axis=1)))].tolist()
    origin = grid.to_grid(*middle)
    frames = [*(replace(f, fix=replace(f.fix, lat_deg=middle[0], lon_deg=middle[1])) for f in photos), *positioned]
    records = _each_its_own_tilt(read_photo_records(frames, grid, origin), len(photos))
    builder = PairGraphBuilder(frames=frames, records=records, read_gray=read_gray, run=run, progress=progress)
    builder.detect_all()
    builder.try_pairs(candidate_pairs(len(photos), len(frames)))
    pairs = builder.pairs()
    if not pairs:
        return PlacedPhotos([], [])
    matches = PairMatches.of(pairs, builder.features)
    shape = shape_of(matches, records, *focal_by_hint(records))
    graph = similarities(matches, records, shape)
    anchors = _anchors(frames, records, points, grid=grid, origin=origin, known=len(photos))
    if searched is not None:
        anchors = anchors.joined(_map_anchors(photos, searched, origin, read_gray, progress))
    if anywhere:
        anchors = _arbitrary_anchors(graph, records)
    anchors = replace(anchors, pixel=level_pixels(anchors.pixel, anchors.photo, records, shape))
    network = solve_free_network(graph, len(frames), records.width, anchors)
    left = [[frames[k].image for k in part] for part in network.left]
    found = _placed(photos, network, records, shape, grid=grid, origin=origin)
    source = SURVEYED if points else BY_OTHERS if searched is None else ON_MAP
    told = {"position": source, "height": source, "angles": source}
    return PlacedPhotos([replace(frame, origin={**frame.origin, **told}) for frame in found], left)


def pictures_moved(photos: Sequence[Frame], *, read_gray: ReadGray, run: Run) -> bool:
    """Whether a vehicle's photos, in order of time and all recorded at one spot, show that it flew on meanwhile."""
    pitch = [frame.fix.pitch_rad for frame in photos if frame.fix.pitch_rad is not None]
    if pitch and float(np.median(pitch)) > _LEVEL_PITCH_RAD:
        return False
    fewest, most = _MOVED_PAIRS
    frames = list(photos[: most + 1])
    grid = LocalGrid(area_epsg([frames[0].fix.lat_deg], [frames[0].fix.lon_deg]))
    origin = grid.to_grid(frames[0].fix.lat_deg, frames[0].fix.lon_deg)
    records = read_photo_records(frames, grid, origin)
    builder = PairGraphBuilder(frames=frames, records=records, read_gray=read_gray, run=run, progress=None)
    builder.detect_all()
    builder.try_pairs(np.column_stack([np.arange(len(frames) - 1), np.arange(1, len(frames))]).astype(np.int32))
    pairs = builder.pairs()
    if len(pairs) < fewest:
        return False
    matches = PairMatches.of(pairs, builder.features)
    graph = similarities(matches, records, shape_of(matches, records, *focal_by_hint(records)))
    turn = graph.factor / np.abs(graph.factor)
    shift = np.abs(graph.centre_first - np.conj(turn) * graph.centre_second) / records.width[graph.first]
    return len(shift) >= fewest and bool(np.median(shift) > _MOVED_SHARE)


def _each_its_own_tilt(records: PhotoRecords, without: int) -> PhotoRecords:
    """The records with a segment for each of the first `without` photos: nothing says that a gimbal held them alike."""
    alone = np.arange(without, dtype=np.int32)
    others = np.unique(records.segment[without:], return_inverse=True)[1].astype(np.int32)
    return replace(records, segment=np.r_[alone, without + others])


def candidate_pairs(without: int, count: int) -> Ints:
    """Pairs with one of the first `without` photos: all, or `_FREE_MOST_PAIRS` nearest in order; int32 (n, 2)."""
    first, second = np.triu_indices(count, 1)
    wanted = first < without
    pairs = np.stack([first[wanted], second[wanted]], axis=1)
    if len(pairs) > _FREE_MOST_PAIRS:
        order = np.argsort(pairs[:, 1] - pairs[:, 0], kind="stable")[:_FREE_MOST_PAIRS]
        pairs = pairs[np.sort(order)]
    return pairs.astype(np.int32)


def _known_places(positioned: Sequence[Frame], points: Sequence[Checkpoint], searched: SearchedMap | None) -> Array:
    """Latitudes and longitudes (n, 2) of the photos with positions, the surveyed points, and the searched area."""
    photos = [(f.fix.lat_deg, f.fix.lon_deg) for f in positioned]
    middle = [] if searched is None else [LocalGrid(searched.basemap.epsg).to_geographic(searched.middle)]
    return np.array([*photos, *((p.surveyed[1], p.surveyed[0]) for p in points), *middle], float).reshape(-1, 2)


def _anchors(
    frames: Sequence[Frame],
    records: PhotoRecords,
    points: Sequence[Checkpoint],
    *,
    grid: LocalGrid,
    origin: Array,
    known: int,
) -> Anchors:
    """Marks of surveyed points, in pixels as taken, and positions of the photos from number `known` on.

    Raises:
        InputError: a mark lies outside its photo, or its name belongs to several photos.
    """
    number = {f.image: k for k, f in enumerate(frames)}
    rows: list[tuple[int, complex, complex, float, float]] = []
    for point in points:
        ground = complex(*(grid.to_grid(point.surveyed[1], point.surveyed[0]) - origin))
        for mark in point.marks:
            name = photo_named(number, mark.image)
            if name is None:
                continue
            frame = frames[number[name]]
            mark.check_inside(frame.width, frame.height)
            pixel = complex(mark.column - 0.5 * (frame.width - 1), -(mark.row - 0.5 * (frame.height - 1)))
            sigma_px = FREE_PAIR_SHARE * frame.width
            rows.append((number[name], pixel, ground, point.sigma_m or SURVEY_SIGMA_M, sigma_px))
    sigma = records.gps_sigma()
    for k in range(known, len(frames)):  # below the camera is the middle of the level picture
        sigma_px = _FREE_NADIR_SHARE * frames[k].width
        rows.append((k, 0j, complex(records.position[k]), float(sigma[k]), sigma_px))
    photo, pixel_, ground_, sigma_m, sigma_px_ = zip(*rows) if rows else ((),) * 5
    return Anchors(
        photo=np.array(photo, np.int32),
        pixel=np.array(pixel_, np.complex128),
        ground=np.array(ground_, np.complex128),
        sigma_m=np.array(sigma_m, float),
        sigma_px=np.array(sigma_px_, float),
    )


def _arbitrary_anchors(graph: PairGraph, records: PhotoRecords) -> Anchors:
    """The photo with most pairs in the largest part, as if it were `_ANYWHERE_M` wide and taken at the origin."""
    largest = np.flatnonzero(components(graph, len(records.width)) == 0)
    pairs = np.bincount(np.r_[graph.first, graph.second], minlength=len(records.width))
    photo = int(largest[pairs[largest].argmax()])
    width = float(records.width[photo])
    at = np.array([0.0, 0.5], np.complex128)  # its middle, and the middle of its right edge
    return Anchors(
        photo=np.full(2, photo, np.int32),
        pixel=at * width,
        ground=at * _ANYWHERE_M,
        sigma_m=np.full(2, FREE_PAIR_SHARE * _ANYWHERE_M),
        sigma_px=np.full(2, FREE_PAIR_SHARE * width),
    )


def _map_anchors(
    photos: Sequence[Frame], searched: SearchedMap, origin: Array, read_gray: ReadGray, progress: Progress | None
) -> Anchors:
    """What the map shows of photos, evenly spread over all, that are found on it."""
    some = spaced(len(photos), _MAP_MOST_PHOTOS).tolist()
    grays = [read_gray(photos[k]) for k in some]
    found, sigma_m = marks_on_map(grays, searched, progress)
    photo, pixel, ground = [np.zeros(0, np.int32)], [np.zeros(0, complex)], [np.zeros(0, complex)]
    for k, gray, marks in zip(some, grays, found, strict=True):
        marks = FoundMarks(*(part[spaced(len(part), _MAP_MOST_MARKS)] for part in marks))
        off = (marks.pixel - 0.5 * (np.array(gray.shape[::-1]) - 1)) * (photos[k].width / gray.shape[1])
        photo.append(np.full(len(off), k, np.int32))
        pixel.append(off[:, 0] - 1j * off[:, 1])
        ground.append((marks.ground - origin) @ [1.0, 1j])
    photo_ = np.concatenate(photo)
    width = np.array([frame.width for frame in photos], float)
    return Anchors(
        photo=photo_,
        pixel=np.concatenate(pixel),
        ground=np.concatenate(ground),
        sigma_m=np.full(len(photo_), sigma_m),
        sigma_px=FREE_PAIR_SHARE * width[photo_],
    )


def _placed(
    photos: Sequence[Frame],
    network: FreeNetwork,
    records: PhotoRecords,
    shape: TiltAndLens,
    *,
    grid: LocalGrid,
    origin: Array,
) -> list[Frame]:
    """The placed photos with a fix from the network: position, angles, and the height where a tag tells the lens."""
    out = []
    yaw, pitch, roll = angles_from_rotation(rotation_of(-np.angle(network.scale), shape.level))
    # Scales give the height over the focal length: without a tag neither is known.
    focal = np.where(np.isfinite(records.fov_hint), np.exp(shape.log_focal), np.nan)[records.lens]
    for k, frame in enumerate(photos):
        if not network.placed[k]:
            continue
        centre = network.centre[k]
        lat, lon = (float(v) for v in grid.to_geographic(origin + np.array([centre.real, centre.imag])))
        leaning = _FREE_NADIR_SHARE * frame.width * abs(network.scale[k])
        fix = replace(
            frame.fix,
            lat_deg=lat,
            lon_deg=lon,
            height_m=float(abs(network.scale[k]) * focal[k]) if np.isfinite(focal[k]) else None,
            yaw_rad=float(yaw[k] + grid.convergence_rad(lat, lon)),
            pitch_rad=float(pitch[k]),
            roll_rad=float(roll[k]),
            position_sigma_m=float(np.hypot(network.sigma_m[k], leaning)),
        )
        out.append(replace(frame, fix=fix))
    return out
