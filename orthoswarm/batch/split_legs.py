"""A single drone's flight treated as a swarm: each straight leg is a vehicle."""

from collections.abc import Sequence
from dataclasses import replace

from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.trajectory.legs import split_legs


def legs_as_vehicles(frames: Sequence[Frame], grid: LocalGrid) -> list[Frame]:
    """Frames with each straight leg renamed to a separate vehicle (`id/leg1`); turns belong to the leg before."""
    members: dict[str, list[Frame]] = {}
    for frame in frames:
        members.setdefault(frame.vehicle, []).append(frame)
    out: list[Frame] = []
    for vehicle, own in members.items():
        ground = grid.to_grid([f.fix.lat_deg for f in own], [f.fix.lon_deg for f in own])
        leg = split_legs(ground)
        last = 0
        for frame, number in zip(own, leg.tolist(), strict=True):
            last = number if number >= 0 else last
            out.append(replace(frame, vehicle=f"{vehicle}/leg{last + 1}"))
    return out
