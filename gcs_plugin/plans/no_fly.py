"""No-fly files: the zones near the flights, as rings for the planner and as fences for the vehicles.

Files of authorities hold all zones of a country. What is farther away than any flight goes is counted, and not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from gcs_plugin.plans.area_files import AreaFile, read_shapes
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Fence, Plan
from orthoswarm.planning.area.shape_files import Ring, Shapes, counted
from orthoswarm.planning.sorties.flight_heights import BESIDE_M

_REACH_M: Final = 5000.0  # zones farther from the area and the starts than this, and than their own extent, are far


class Reach:
    """A box about what is flown over, in degrees, wide enough for the ways around zones."""

    def __init__(self, flown: Ring) -> None:
        """flown: float64 (n, 2), latitude and longitude in degrees, of the area or the lines and of the starts."""
        self._lon = float(flown[0, 1])
        east = wrap_deg(flown[:, 1] - self._lon)
        low, high = np.array([flown[:, 0].min(), east.min()]), np.array([flown[:, 0].max(), east.max()])
        metres = DEGREE_M * np.array([1.0, max(np.cos(np.radians(np.abs(flown[:, 0]).max())), 0.01)])
        beyond = max(_REACH_M, float(np.linalg.norm((high - low) * metres))) / metres
        self._low, self._high, self._metres = low - beyond, high + beyond, metres

    def touches(self, ring: Ring, grown_m: float = 0.0) -> bool:
        """Whether the box about a ring (or a point), so much larger, has ground in common with this one."""
        first = wrap_deg(float(ring[0, 1]) - self._lon)
        east = first + wrap_deg(ring[:, 1] - ring[0, 1])  # a zone across the date line is no belt around the Earth
        low, high = np.array([ring[:, 0].min(), east.min()]), np.array([ring[:, 0].max(), east.max()])
        grown = grown_m / self._metres
        return bool((low - grown <= self._high).all() and (high + grown >= self._low).all())

    def touches_exchanged(self, shapes: Shapes) -> bool:
        """Whether it would touch shapes whose latitudes were their longitudes."""
        centres = [np.array([[circle.lat_deg, circle.lon_deg]]) for circle in shapes.circles]
        return any(self.touches(ring[:, ::-1]) for ring in [*(p.shell for p in shapes.polygons), *centres])

    def near(self, shapes: Shapes) -> Shapes:
        """The polygons and circles of shapes that it touches."""
        polygons = tuple(p for p in shapes.polygons if self.touches(p.shell))
        centre = {circle: np.array([[circle.lat_deg, circle.lon_deg]]) for circle in shapes.circles}
        circles = tuple(c for c in shapes.circles if self.touches(centre[c], c.radius_m))
        return replace(shapes, polygons=polygons, circles=circles)


@dataclass(frozen=True, slots=True)
class NoFly:
    """The no-fly zones of a plan.

    Attributes:
        rings: outlines of polygons, of exclusion fences, and around circles. fences: of missions, and circles.
        circles_wider_m: by how much rings lie outside their circles, 0 without a circle.
        reach: of which the zones are all of its files; notes: on what is not used.
    """

    rings: list[Ring]
    fences: list[Fence]
    circles_wider_m: float
    reach: Reach
    notes: list[str]

    def refuse_beyond(self, plan: Plan) -> None:
        """Refuse a plan that leads to where zones were not used; raises InputError: it does."""
        points = [(w.lat_deg, w.lon_deg) for v in plan.vehicles for s in v.sorties for w in s.waypoints]
        if self.notes and not all(self.reach.touches(np.array([point])) for point in points):
            raise InputError(
                "the way around no-fly zones leads farther than the zones that were used; plan from nearer starts, or "
                "give files of the zones around there only"
            )


def read_no_fly(paths: Sequence[Path], flown: Ring, clearance_m: float | None) -> NoFly:
    """The zones of no-fly files near what is flown over.

    Circles become fences of the vehicles, so rings keep the distance at which receivers do not break a fence.

    Args:
        paths: of the files. flown: see Reach. clearance_m: distance that plans keep to zones by themselves.

    Raises:
        InputError: a file cannot be read, or holds anything that no vehicle could be kept out of.
    """
    reach, rings, fences, notes, round_ = Reach(flown), list[Ring](), list[Fence](), list[str](), False
    beyond_m = max(0.0, BESIDE_M - (clearance_m or 0.0))
    for path in paths:
        file = read_zones(path)
        near = reach.near(file.shapes)
        far = len(file.shapes.polygons) + len(file.shapes.circles) - len(near.polygons) - len(near.circles)
        if far and not near.polygons and not near.circles and reach.touches_exchanged(file.shapes):
            raise InputError(
                f"{path.name} has zones at the flights if latitude and longitude are exchanged; longitude comes first"
            )
        if far:
            notes.append(f"of {path.name}, {', '.join(counted({'zone': far}))} far from the flights: not used")
        rings += [p.shell for p in near.polygons] + [c.polygon(beyond_m).shell for c in near.circles] + file.no_fly
        fences += file.fences
        fences += [Fence(inclusion=False, points=((c.lat_deg, c.lon_deg),), radius_m=c.radius_m) for c in near.circles]
        round_ = round_ or bool(near.circles)
    return NoFly(rings, fences, beyond_m if round_ else 0.0, reach, notes)


def read_zones(path: Path) -> AreaFile:
    """What vehicles are to keep out of, by a no-fly file: all of it, also what is switched off there.

    Raises:
        InputError: the file cannot be read, or holds anything that no vehicle could be kept out of.
    """
    file = read_shapes(path, any_size=True)
    shapes = file.shapes
    refuse_no_zones(shapes, str(path), mission=bool(file.no_fly))
    shapes = replace(shapes, polygons=shapes.polygons + shapes.hidden, hidden=())
    if not shapes.polygons and not shapes.circles and not file.no_fly:
        raise InputError(f"{path} holds no polygon to keep out of; give a polygon with --no-fly")
    return file._replace(shapes=shapes)


def refuse_no_zones(shapes: Shapes, name: str, *, mission: bool = False) -> None:
    """Refuse shapes of which a part would be passed over as no-fly zones; a mission's lines are flown.

    Raises:
        InputError: there are such shapes.
    """
    count = 0 if mission else len(shapes.lines)
    left = [*shapes.unused, *counted({"line": count} if count else {})]
    if left:
        raise InputError(
            f"{name} holds {', '.join(left)}, which no vehicle could be kept out of; draw each zone as a polygon, or "
            "give a point its radius_m and a line its width_m, in metres"
        )
