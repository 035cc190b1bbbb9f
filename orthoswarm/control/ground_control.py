"""Moving a refined block onto surveyed points, photos and terrain together.

The control points do not enter the bundle adjustment: relative to the basemap a block is accurate to centimetres, and
the map's own error is one shift (with a small rotation and scale) common to all vehicles, so only this similarity is
estimated. Deformations within the block remain; they are part of the stated sigma.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from orthoswarm.control.control_observations import in_photos, on_basemap
from orthoswarm.control.similarity import ControlFit, fit_similarity, moved_camera, moved_terrain
from orthoswarm.evaluation.checkpoints import RECEIVERS_LOCAL_SIGMA_M, Checkpoint
from orthoswarm.model.arrays import Array
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Leg, PlacedFrame, Refinement, Solution, Terrain

_SCATTER_TOLD_M: Final = 0.5  # points that scatter by more than this are warned about, one sigma of an axis
_BORDER_M: Final = 0.5
"""Photos on a basemap, or where receivers say, are turned and scaled by so little that a place at their
root-mean-square radius changes by this, one sigma: one or two points shift them, more points turn and scale them, too.
Measured on 172 photos where receivers say (radius 54 m) by five control points, each choice of two of them placing the
other three: with 0.05, 0.5 and 1.5 m these are 0.72, 0.75 and 0.99 m off (three points: 0.68, 0.67 and 0.73 m)."""
_FREE_BORDER_SHARE: Final = 0.1
"""... and as a share of that radius where no receiver says anything: the points alone turn and scale such a block."""


@dataclass(frozen=True, slots=True)
class GroundControl:
    """Result of the ground control.

    on_map: the fit of the photos registered on the basemap; by_receivers: of the others. None without a control point
    in these photos. warnings: findings in plain words.
    """

    on_map: ControlFit | None
    by_receivers: ControlFit | None
    warnings: list[str]

    def document(self) -> dict[str, Any] | None:
        """As JSON values, of the larger part of the photos that were moved; None if none were."""
        fit = self.on_map or self.by_receivers
        if fit is None:
            return None
        similarity = fit.similarity
        miss = np.array([0.0 if o.rays is None else o.rays.miss_m for o in fit.used])
        rms = float(np.sqrt(((fit.residual**2).sum(axis=1) + miss**2).mean()))
        return {
            "points": len(fit.used),
            "shift_m": {"east": float(similarity.values[0]), "north": float(similarity.values[1])},
            "turn_deg": float(np.degrees(similarity.turn_rad)),
            "scale": similarity.scale,
            "sigma_m": float(similarity.sigma_m(similarity.middle)),
            "residual_rms_m": rms,
            "residuals": [
                {
                    "name": o.name,
                    "east_m": float(r[0]),
                    "north_m": float(r[1]),
                    "sigma_m": o.sigma_m,
                    "rays_miss_m": None if o.rays is None else o.rays.miss_m,
                }
                for o, r in zip(fit.used, fit.residual, strict=True)
            ],
            "left_out": [o.name for o in fit.left_out],
        }


def place_on_control(
    refinement: Refinement, points: Sequence[Checkpoint], grid: LocalGrid, map_gsd_m: float | None
) -> tuple[Refinement, GroundControl]:
    """Move the fine cameras and their terrain onto control points; the given refinement is not modified.

    map_gsd_m: the basemap's pixel, None without a basemap. Raises InputError: a point's pixel lies outside its photo.
    """
    placed = [p for s in refinement.fine for p in s.placed]
    terrain = refinement.terrain or Terrain.flat()
    fits: dict[bool, ControlFit] = {}
    for on_map in (True, False):
        own = [p for p in placed if (p.stage == "fine") == on_map]
        if not own:
            continue
        observations = in_photos(points, own, terrain, grid, on_map)
        if on_map and map_gsd_m is not None:
            observations += on_basemap(points, grid, map_gsd_m)
        if observations:
            nadirs = np.array([p.camera.nadir for p in own])
            fits[on_map] = fit_similarity(observations, nadirs, _border_m(own, nadirs))
    result = GroundControl(fits.get(True), fits.get(False), _warnings(fits, placed))
    if not fits:
        return refinement, result
    level = float(np.median(terrain.height(np.array([p.camera.nadir for p in placed]))))
    # The common error of the photos positioned by receivers.
    base = min((p.sigma_m for p in placed if p.stage != "fine" and np.isfinite(p.sigma_m)), default=0.0)

    def moved(p: PlacedFrame) -> PlacedFrame:
        fit = fits.get(p.stage == "fine")
        return p if fit is None else _moved(p, fit, level, base)

    main = fits.get(True) or fits[False]
    scale = main.similarity.scale

    def solution(s: Solution) -> Solution:
        own = [moved(p) for p in s.placed]
        return replace(s, placed=own, legs=_restated(s.legs, own), ground_z_m=level + scale * (s.ground_z_m - level))

    fine = [solution(s) for s in refinement.fine]
    ground = None if refinement.terrain is None else moved_terrain(refinement.terrain, main.similarity, level)
    return replace(refinement, fine=fine, terrain=ground), result


def _border_m(placed: Sequence[PlacedFrame], nadirs: Array) -> float:
    if any(p.stage == "fine" or p.frame.has_own_position for p in placed):
        return _BORDER_M
    return max(_FREE_BORDER_SHARE * float(np.sqrt(nadirs.var(axis=0).sum())), _BORDER_M)


def _restated(legs: Sequence[Leg], placed: Sequence[PlacedFrame]) -> list[Leg]:
    """Legs with the sigma that their photos have now."""
    sigma = np.array([p.sigma_m for p in placed])
    return [
        replace(leg, sigma_m=float(np.median(sigma[leg.first : leg.last + 1]))) if leg.first < len(sigma) else leg
        for leg in legs
    ]


def _moved(placed: PlacedFrame, fit: ControlFit, level_m: float, base_sigma_m: float) -> PlacedFrame:
    """A photo after a similarity, and its sigma."""
    similarity, camera = fit.similarity, placed.camera
    own = placed.sigma_m
    if placed.stage != "fine":  # the receivers' common error has given way to that of the control points
        own = float(np.hypot(np.sqrt(max(own**2 - base_sigma_m**2, 0.0)), RECEIVERS_LOCAL_SIGMA_M))
    sigma = float(np.hypot(own, similarity.sigma_m(camera.nadir)))
    return replace(placed, camera=moved_camera(camera, similarity, level_m), sigma_m=sigma)


def _warnings(fits: dict[bool, ControlFit], placed: Sequence[PlacedFrame]) -> list[str]:
    if not fits:
        return [
            "no control point is seen in a photo that was mapped (or has its place on the basemap): they were not used"
        ]
    said = []
    for fit in fits.values():
        for o in (*fit.used, *fit.left_out):
            said += [] if o.rays is None else [f"control {finding}" for finding in o.rays.findings(o.name)]
        for o in fit.left_out:
            away = fit.similarity.moved(o.placed) - o.surveyed
            said.append(
                f"control point {o.name} was left out: the others put it {np.hypot(*away):.1f} m ({away[0]:+.1f} east, "
                f"{away[1]:+.1f} north) from its survey; check its coordinates and where it was marked"
            )
        if fit.scatter_m > _SCATTER_TOLD_M:
            said.append(
                f"the control points agree to {fit.scatter_m:.1f} m only (one sigma of an axis; no sigma_m was given): "
                "the map's place is as good as they are; survey them better, or check their marks"
            )
        if fit.contradiction:
            names = ", ".join(o.name for o in fit.used)
            worst = float(np.hypot(*fit.residual.T).max())
            said.append(
                f"the control points {names} contradict each other (up to {worst:.1f} m are left): check their "
                "coordinates and marks, or add points, so that the wrong one can be found"
            )
    for on_map, where in ((True, "on the basemap"), (False, "where the receivers say")):
        others = sum((p.stage == "fine") == on_map for p in placed)
        if others and on_map not in fits:
            said.append(f"no control point is marked in the {others} photos that lie {where}: they are not moved")
    return said
