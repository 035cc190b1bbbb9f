"""Decides from the pictures whether cameras of one name share a lens; zooms and similar models do not.

One lens model for cameras of different focal lengths deforms the ground and the orientations (measured: fields
of view of 95 and 105 degrees under one name came out 10 degrees off, heights 24 m off 150 m).
"""

from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.refine.initial.initial_orientation import InitialOrientation
from orthoswarm.refine.initial.planar_similarity import PhotoRecords

_UNLIKE_SIGMAS: Final = 2.5  # vehicles' focal lengths that differ by more sigmas are of two lenses
_UNLIKE_SHARE: Final = 0.06  # ... and by more than this share
_ONE_WAY_CONCENTRATION: Final = 0.9  # mean unit vector of headings from which shapes give no focal length


def lens_per_vehicle(records: PhotoRecords) -> PhotoRecords:
    """The records with a separate lens for each vehicle."""
    first = np.unique(records.vehicle, return_index=True)[1]
    return replace(records, lens=records.vehicle.copy(), fov_hint=records.fov_hint[records.lens[first]])


def split_unlike_lenses(records: PhotoRecords, alone: InitialOrientation) -> PhotoRecords:
    """Share lenses between vehicles as far as the pictures allow.

    Args:
        records: of vehicles that share lenses by name.
        alone: start values of the same photos with a lens for each vehicle (see `lens_per_vehicle`).

    Returns:
        The same records if no vehicle's focal length differs from that of others with its camera name.
    """
    one_way = _ONE_WAY_CONCENTRATION
    vehicles = len(alone.focal)
    name = np.array([int(records.lens[records.vehicle == v][0]) for v in range(vehicles)])
    sure = np.array([abs(np.exp(1j * alone.yaw[records.vehicle == v]).mean()) < one_way for v in range(vehicles)])
    lens = np.zeros(vehicles, np.int32)
    count = 0
    for k in np.unique(name):
        members = np.flatnonzero(name == k)
        group = group_focal_lengths(np.log(alone.focal[members]), alone.focal_sigma[members], sure[members])
        lens[members] = count + group
        count += int(group.max()) + 1
    if count == len(records.fov_hint):
        return records
    hint = np.array([records.fov_hint[name[lens == k][0]] for k in range(count)])
    return replace(records, lens=lens[records.vehicle], fov_hint=hint)


def group_focal_lengths(log_focal: Array, sigma: Array, sure: Flags) -> Ints:
    """Group of each vehicle (V,): in order of certainty, with a new group for a value unlike all existing groups."""
    group = np.zeros(len(log_focal), np.int32)
    weight, mean = np.zeros(0), np.zeros(0)
    for v in sorted(range(len(log_focal)), key=lambda v: (not sure[v], sigma[v])):
        off = np.abs(log_focal[v] - mean)
        near = int(off.argmin()) if len(off) else -1
        limit = 0.0
        if near >= 0:
            total_sigma = float(np.hypot(sigma[v], weight[near] ** -0.5))
            limit = max(_UNLIKE_SHARE, _UNLIKE_SIGMAS * total_sigma)
        if near < 0 or (sure[v] and off[near] > limit):
            group[v] = len(mean)
            weight, mean = np.append(weight, sigma[v] ** -2), np.append(mean, log_focal[v])
            continue
        group[v] = near
        total = weight[near] + sigma[v] ** -2
        mean[near] += (log_focal[v] - mean[near]) * sigma[v] ** -2 / total
        weight[near] = total
    return group
