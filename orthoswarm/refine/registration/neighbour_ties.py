"""Links to neighbouring vehicles: own points observed in pictures of their cameras, which stay fixed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.config import active
from orthoswarm.model.arrays import Array, Flags, Gray, Indices, Ints
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import CameraBlock, Tracks
from orthoswarm.refine.bundle.observation_selection import one_per_cell
from orthoswarm.refine.bundle.priors import Priors
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.registration.block_state import VehicleState, lies_on_map
from orthoswarm.refine.registration.tie_points import LINK_VIEW_WEIGHT, LINK_VIEWS, link_legs

_NEIGHBOUR_SIGMA_PX: Final = 1.5  # sigma of a link to another vehicle, whose cameras do not move, working pixels
_NEIGHBOUR_PICTURES: Final = 2  # most vehicles in which a point is observed, one picture each (cost)
_NEIGHBOUR_REACH_HEIGHTS: Final = 1.2  # other vehicles' cameras within so many flying heights may show its ground
_NEIGHBOUR_EVERY: Final = 2  # every so-manieth of these cameras is used: neighbours in time show the same (cost)


@dataclass(frozen=True, slots=True)
class FixedCameras:
    """Cameras of neighbours that may show a vehicle's ground; they do not move in its adjustment.

    Attributes:
        cameras: M of them. vehicle: int32 (M,), number of their vehicle.
        gray: picture i at working scale. small: picture i, reduced.
    """

    cameras: CameraBlock
    vehicle: Ints
    gray: Callable[[int], Gray]
    small: Callable[[int], Gray]


def fixed_cameras_near(state: VehicleState, others: Sequence[VehicleState]) -> FixedCameras | None:
    """The neighbours' cameras near a vehicle's path (not all are needed); None where there are none."""
    own = state.flight.adjustment.cameras.position[:, :2]
    height = float(np.median(state.flight.adjustment.cameras.position[:, 2]))
    reach = _NEIGHBOUR_REACH_HEIGHTS * height
    low, high = own.min(0) - reach, own.max(0) + reach
    parts: list[tuple[VehicleState, Indices]] = []
    for other in others:
        xy = other.flight.adjustment.cameras.position[: len(other.flight.frames), :2]
        within = ((xy > low) & (xy < high)).all(1) & (other.flight.leg >= 0)
        near = np.flatnonzero(within)[::_NEIGHBOUR_EVERY]
        fits = other.on_map if state.on_map else lies_on_map(other) == lies_on_map(state)
        if len(near) and fits:
            parts.append((other, near))
    if not parts:
        return None
    rigs = [o.flight.adjustment.cameras.take(near) for o, near in parts]
    lens_at = np.cumsum([0] + [len(r.lens) for r in rigs])
    cameras = CameraBlock(
        np.concatenate([r.position for r in rigs]),
        np.concatenate([r.rotation for r in rigs]),
        np.concatenate([r.lens_id + lens_at[k] for k, r in enumerate(rigs)]).astype(np.int32),
        np.concatenate([r.lens for r in rigs]),
    )
    vehicle = np.concatenate([np.full(len(near), k, np.int32) for k, (_, near) in enumerate(parts)])
    where = [(o, int(i)) for o, near in parts for i in near]
    return FixedCameras(
        cameras,
        vehicle,
        lambda j: where[j][0].flight.pictures.gray(where[j][1]),
        lambda j: where[j][0].flight.pictures.small(where[j][1]),
    )


def link_to_fixed(
    flight: Flight,
    fixed: FixedCameras,
    gsd_m: float,
    *,
    reach_px: int | None = None,
    pictures: Flags | None = None,
    cell_m: float | None = None,
) -> int:
    """Observe own points in fixed pictures and add these observations; the fixed cameras are appended to the block.

    Args:
        gsd_m: pixel in which they are compared. reach_px: how far a point is searched there, None: as configured.
        pictures: bool (N,), own ones to compare, None for all. cell_m: one point a leg in each cell of this size,
            None: as configured.
    """
    config = active().registration
    adj = flight.adjustment
    n = len(adj.cameras)
    joint = _joined(adj.cameras, fixed.cameras)
    seen = flight.best_views(pictures)
    usable = (seen.camera >= 0) & (seen.count >= LINK_VIEWS) & (seen.mean_weight > LINK_VIEW_WEIGHT)
    leg = np.concatenate([flight.leg, int(flight.leg.max()) + 1 + fixed.vehicle]).astype(np.int32)
    cost = np.where(usable, -seen.count.astype(float), np.inf)
    cell_m = config.link_cell_m if cell_m is None else cell_m
    chosen = one_per_cell(adj.points, leg[np.maximum(seen.camera, 0)], cost, cell_m)
    candidates = np.arange(n, len(joint))

    def gray(i: int) -> Gray:
        return flight.pictures.gray(i) if i < n else fixed.gray(i - n)

    camera, point, uv, _ = link_legs(
        joint,
        adj.points,
        chosen,
        camera=seen.camera,
        leg=leg,
        candidates=candidates,
        gray=gray,
        gsd_m=gsd_m,
        most=_NEIGHBOUR_PICTURES,
        reach=reach_px,
    )
    if not len(camera):
        return 0
    tracks = Tracks(
        np.concatenate([adj.tracks.camera, camera]),
        np.concatenate([adj.tracks.point, point]),
        np.concatenate([adj.tracks.uv, uv]),
        np.concatenate([adj.tracks.sigma_px, np.full(len(camera), _NEIGHBOUR_SIGMA_PX, np.float32)]),
    )
    free = np.arange(len(joint)) < n
    new = Adjustment.begin(
        joint, tracks, _padded(adj.priors, len(fixed.cameras), len(fixed.cameras.lens)), adj.points, free
    )
    shift = new.layout.lens_columns - adj.layout.lens_columns
    new.common[: adj.layout.lens_columns] = adj.common[: adj.layout.lens_columns]
    new.common[adj.layout.lens_columns + shift :] = adj.common[adj.layout.lens_columns :]
    new.priors.lens[len(adj.priors.lens) :] = _lens_values(fixed.cameras.lens)
    flight.adjustment = new
    return len(camera)


def remove_fixed(flight: Flight) -> None:
    """Remove the fixed cameras and their observations from a flight's adjustment."""
    adj = flight.adjustment
    n, lenses = len(flight.frames), int(adj.cameras.lens_id[: len(flight.frames)].max()) + 1
    own = adj.tracks.camera < n
    tracks = Tracks(adj.tracks.camera[own], adj.tracks.point[own], adj.tracks.uv[own], adj.tracks.sigma_px[own])
    cameras = replace(adj.cameras.take(slice(0, n)), lens=adj.cameras.lens[:lenses])
    p = adj.priors
    priors = replace(
        p,
        position=p.position[:n],
        position_sigma=p.position_sigma[:n],
        rotation=p.rotation[:n],
        rotation_sigma=p.rotation_sigma[:n],
        velocity=p.velocity[:n],
        group=p.group[:n],
        lens=p.lens[:lenses],
        lens_sigma=p.lens_sigma[:lenses],
    )
    new = Adjustment.begin(cameras, tracks, priors, adj.points)
    new.common[: 6 * lenses] = adj.common[: 6 * lenses]
    new.common[6 * lenses :] = adj.common[adj.layout.lens_columns :]
    weight = adj.obs_weight[own]
    order = np.lexsort((tracks.camera, tracks.point))
    new.obs_weight[:] = weight[order]
    new.point_inverse[:] = adj.point_inverse
    new.tie_residual = adj.tie_residual
    flight.adjustment = new


def _joined(a: CameraBlock, b: CameraBlock) -> CameraBlock:
    return CameraBlock(
        np.concatenate([a.position, b.position]),
        np.concatenate([a.rotation, b.rotation]),
        np.concatenate([a.lens_id, b.lens_id + len(a.lens)]).astype(np.int32),
        np.concatenate([a.lens, b.lens]),
    )


def _lens_values(lens: Array) -> Array:
    return np.column_stack([np.log(lens[:, 0]), lens[:, 1:6]])


def _padded(p: Priors, cameras: int, lenses: int) -> Priors:
    """Priors with room for fixed cameras; they belong to no sortie and their lenses do not change."""
    return replace(
        p,
        position=np.concatenate([p.position, np.zeros((cameras, 3))]),
        position_sigma=np.concatenate([p.position_sigma, np.full((cameras, 3), np.inf)]),
        rotation=np.concatenate([p.rotation, np.broadcast_to(np.eye(3), (cameras, 3, 3))]),
        rotation_sigma=np.concatenate([p.rotation_sigma, np.full((cameras, 3), np.inf)]),
        velocity=np.concatenate([p.velocity, np.zeros((cameras, 2))]),
        group=np.concatenate([p.group, np.full(cameras, -1)]).astype(np.int32),
        lens=np.concatenate([p.lens, np.zeros((lenses, 6))]),
        lens_sigma=np.concatenate([p.lens_sigma, np.zeros((lenses, 6))]),
    )
