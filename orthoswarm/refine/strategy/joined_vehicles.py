"""Vehicles that no map holds, made one block: registered to their neighbours, placed together by all receivers.

Receivers without corrections differ by metres, so that ground would jump from vehicle to vehicle. Relative places come
from the pictures; the absolute place is the mean of what all receivers say, as in a free network adjustment.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import STATED_SIGMA_FACTOR
from orthoswarm.model.plane_similarity import Similarity
from orthoswarm.model.task_runner import Run
from orthoswarm.refine.bundle.covariance import RECEIVER_COMMON_SIGMA_M
from orthoswarm.refine.bundle.priors import ATTITUDE_BIAS_SIGMA_DEG, POSITION_ROBUST_C
from orthoswarm.refine.registration.block_state import VehicleState, WorkArea, lies_on_map
from orthoswarm.refine.registration.coarse_map import is_coarse, shift_on_coarse_map
from orthoswarm.refine.registration.map_offset import had_corrections
from orthoswarm.refine.registration.neighbour_registration import join_neighbours
from orthoswarm.refine.strategy.vehicle_group import neighbours_of
from orthoswarm.refine.surface.vehicle_ground import fit_surface

Block = list[int]
Join = Callable[[tuple[VehicleState, list[VehicleState]]], VehicleState]

_DATUM_SHIFT_SIGMA_M: Final = 100.0  # what is known of the shift of such a block before its receivers are asked
_DATUM_ROUNDS: Final = 5  # rounds of reweighting, so that a receiver that is far off counts little
TAKEOFF_LEVEL_SIGMA_M: Final = 2.0  # how well the takeoff spot is known to lie at the level of the ground


def join_unmapped(
    states: Sequence[VehicleState], others: Sequence[VehicleState], area: WorkArea, run: Run
) -> tuple[list[VehicleState], list[Block]]:
    """Register vehicles that no map holds to each other.

    Vehicles whose receivers had corrections stay where they are, as do `others`; the rest is registered to them. A
    block without any of these is placed by all its receivers together, or shifted onto a map too coarse to show single
    pictures.

    Returns:
        The states in order; the numbers of the unmapped ones by block, each after those that it was registered to.
    """
    out, join = list(states), partial(join_neighbours, area=area)
    left = [k for k, state in enumerate(out) if not lies_on_map(state)]
    held = [state for state in others if not lies_on_map(state)]
    blocks = [[k for k in left if had_corrections(out[k].flight.frames)]]
    _grow(out, blocks[0], left, held=held, join=join, run=run)
    while left := [k for k in left if not any(k in block for block in blocks)]:
        rest = [out[k] for k in left]
        block = [max(left, key=lambda k: (len(neighbours_of(out[k], rest)), -k))]  # few steps from there to the others
        _grow(out, block, left, held=[], join=join, run=run)
        _back_to_receivers(out, block)
        blocks.append(block)
    if not held:
        for block in blocks[1:]:  # corrected receivers are more accurate than such a map
            _onto_coarse_map(out, block, area)
    return out, [block for block in blocks if block]


def _grow(
    out: list[VehicleState], block: Block, left: Sequence[int], *, held: list[VehicleState], join: Join, run: Run
) -> None:
    """Register vehicles to those of a block and to `held`, then others to these, until no more is found."""
    added = [*held, *(out[k] for k in block)]
    while added:
        waiting = [k for k in left if k not in block and neighbours_of(out[k], added)]
        anchors = [*held, *(out[k] for k in block)]
        items = [(out[k], neighbours_of(out[k], anchors)) for k in waiting]
        found = list(zip(waiting, run(join, items), strict=True))
        for k, state in found:
            out[k] = state
        new = [k for k, state in found if state.joined]
        block += new
        added = [out[k] for k in new]


def _back_to_receivers(out: list[VehicleState], block: Block) -> None:
    """Shift, turn and scale a block so that its vehicles lie where their receivers say, as nearly as they can together.

    Each receiver has its own bias: over several vehicles they tell scale and heading, too, as do the vehicles' own
    solutions, whose headings have independent errors; the takeoff level, which gives the scale, may be one for all.
    """
    if len(block) < 2:
        return
    own = [_own_solution(out[k]) for k in block]
    now, alone = (np.array([o[i] for o in own]) for i in (0, 1))
    weight = np.array([1.0 / o[3] ** 2 for o in own])
    level_sigma = TAKEOFF_LEVEL_SIGMA_M / max(float(np.median(now[:, 2])), 1.0)
    turn = float(np.average([o[2] for o in own], weights=weight))
    prior = np.array([0.0, 0.0, turn, float(np.mean(alone[:, 2] / now[:, 2])) - 1.0])
    prior_sigma = np.array([_DATUM_SHIFT_SIGMA_M, _DATUM_SHIFT_SIGMA_M, 1.0 / np.sqrt(weight.sum()), level_sigma])
    sigma_m, counts = np.array([out[k].receiver_sigma_m for k in block]), np.ones(len(block))
    for _ in range(_DATUM_ROUNDS):
        sigma, middle = sigma_m / np.sqrt(counts)[:, None], now[:, :2].mean(axis=0)
        similarity = Similarity.between(
            now[:, :2], alone[:, :2], sigma, middle=middle, prior_sigma=prior_sigma, prior=prior
        )
        away = (((similarity.moved(now[:, :2]) - alone[:, :2]) / sigma_m) ** 2).sum(axis=1)
        counts = robust_weights(away, POSITION_ROBUST_C)
    level_m, factor = _level_m(out, block), STATED_SIGMA_FACTOR
    for k in block:
        placed = np.hypot(similarity.sigma_m(out[k].flight.cameras().position[:, :2]), RECEIVER_COMMON_SIGMA_M)
        out[k] = replace(_moved(out[k], similarity, level_m), datum_sigma_m=factor * placed)


def _onto_coarse_map(out: list[VehicleState], block: Block, area: WorkArea) -> None:
    """Shift a block onto a coarse map that shows its ground, if there is one."""
    basemap = area.basemap
    if basemap is None or not block or not all(is_coarse(out[k].flight, basemap) for k in block):
        return
    found = shift_on_coarse_map([out[k].flight for k in block], basemap, area.origin, _level_m(out, block))
    if found is None:
        return
    shift = Similarity(np.zeros(2), np.array([found.east, found.north, 0.0, 0.0]), np.zeros((4, 4)))
    for k in block:
        moved = _moved(out[k], shift, 0.0)
        out[k] = replace(moved, coarse_shift=found, confidence=found.confidence, false_matches=found.false_matches)


def _level_m(out: Sequence[VehicleState], block: Block) -> float:
    """Median height of a block's points, metres."""
    return float(np.median(np.concatenate([out[k].flight.adjustment.points[:, 2] for k in block])))


def _own_solution(state: VehicleState) -> tuple[Array, Array, float, float]:
    """A vehicle's mean position (3,) now and as solved alone, the turn to that (radians) and its sigma."""
    now, alone = state.flight.adjustment.cameras, state.coarse
    apart = alone.rotation @ now.rotation.transpose(0, 2, 1)
    turn = float(np.median(np.arctan2(apart[:, 1, 0] - apart[:, 0, 1], apart[:, 0, 0] + apart[:, 1, 1])))
    sigma = float(np.radians(ATTITUDE_BIAS_SIGMA_DEG[2]))
    if state.pose_covariance is not None:
        sigma = float(np.sqrt(np.median(state.pose_covariance[:, 5, 5])))
    return now.position.mean(axis=0), alone.position.mean(axis=0), turn, sigma


def _moved(state: VehicleState, similarity: Similarity, level_m: float) -> VehicleState:
    """A state after a similarity; its records move by as much, so that its adjustment stays where it is."""
    state = deepcopy(state)
    adj = state.flight.adjustment
    before = adj.cameras.position.copy()
    for place in (adj.cameras.position, adj.points):
        place[:, :2] = similarity.moved(place[:, :2])
        place[:, 2] = similarity.moved_heights(place[:, 2], level_m)
    adj.cameras.rotation[:] = similarity.about_up @ adj.cameras.rotation
    p = adj.priors
    adj.priors = replace(
        p, position=p.position + adj.cameras.position - before, rotation=similarity.about_up @ p.rotation
    )
    ground = replace(state.surface, level_m=float(similarity.moved_heights(state.surface.level_m, level_m)))
    state.surface = fit_surface(adj, ground)
    return state
