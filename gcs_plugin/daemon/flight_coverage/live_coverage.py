"""Coverage of the planned area in flight, updated by one thread from pictures, solutions and vehicles.

Pictures count with their recorded poses as soon as they are on the map, and with their placed ones once their leg is
placed. At a start all is rebuilt from the journal and the solution files; the finished legs are in the journal.
"""

import io
import logging
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypedDict

import numpy as np
from numpy.typing import NDArray

from gcs_plugin.daemon.flight_coverage.exposure_journal import ExposureJournal
from gcs_plugin.daemon.flight_coverage.flown_legs import (
    AreaSource,
    BatteryUse,
    CoveredArea,
    FlownLegs,
    area_source,
    flies,
    read_covered_area,
    zone_features,
)
from gcs_plugin.daemon.flight_coverage.picture_views import FlawedPictures, Measured, PictureViews
from gcs_plugin.daemon.layers.realtime_layer import Drawer
from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store.console_state import ConsoleState
from gcs_plugin.daemon.store.daemon_events import Events, PictureDrawn
from gcs_plugin.daemon.store.frame_rows import last_drawn_arrival
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.vehicle_names import VehicleRow
from orthoswarm.coverage.coverage_files import COLOURS, gap_feature
from orthoswarm.coverage.coverage_grid import Cells, CellState, CoverageGrid, Shares
from orthoswarm.coverage.gaps import below_legs, find_gaps
from orthoswarm.coverage.missing_pictures import MissingPicture, missing_by_events
from orthoswarm.coverage.planning_lens import planning_fovs_deg
from orthoswarm.coverage.view import View
from orthoswarm.export.product_files import iso_time
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import GroundGrid, LocalGrid
from orthoswarm.raster.picture_quality import PictureQuality

Rows = list[VehicleRow]
_LOOK_S: Final = 0.5
_LEAST_PAUSE: Final = 3.0
"""Pause after finding gaps, in multiples of the time that it took: a quarter of one core at most."""
_MOST_CELLS: Final = 16_000_000  # of the grid; cells grow beyond it
_ON_THE_WAY_S: Final = 15.0
_FACT: Final = "coverage"
_TOLD: Final = ("state", "version", "seen_share", "poor_share", "missed_share", "planned_share")
_log = logging.getLogger(__name__)
_LARGEST_PX: Final = 2048
_SHOWN_FIRST: Final = (CellState.MISSED, CellState.POOR, CellState.PLANNED, CellState.SEEN, CellState.EXCLUDED)


@dataclass(kw_only=True)
class _Followed:
    """The area being covered.

    Attributes:
        source: its source. covered: the area and its plan. legs: which of its legs are finished.
        cover: by pictures as placed now. recorded: by recorded poses alone.
        flaws: of the pictures, by comparison with their neighbours.
        stored: state of `legs` in the journal. over: the finished legs for which the due cells were last computed.
    """

    source: AreaSource
    covered: CoveredArea
    legs: FlownLegs
    cover: CoverageGrid
    recorded: CoverageGrid
    flaws: FlawedPictures = field(default_factory=FlawedPictures)
    stored: dict[str, Any] = field(default_factory=dict)
    over: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))


class MissingRow(TypedDict):
    """A picture that was taken, or should have been, and is not there; `image`: its name, or `event <number>`."""

    vehicle: str
    image: str
    after: str
    cause: str
    confidence: float
    time_s: float | None


class CoverageDocument(TypedDict, total=False):
    """What /api/coverage answers: shares of the area by state, gaps with their causes, and what they come from."""

    state: str
    version: int
    time: str | None
    plan: str | None
    seen_share: float | None
    poor_share: float | None
    missed_share: float | None
    planned_share: float | None
    recorded: dict[str, float]
    pictures: dict[str, int]
    area_m2: float
    cell_m: float
    offers: list[dict[str, Any]]
    legs: dict[str, int]
    corners: list[list[float]]
    gaps: list[dict[str, Any]]
    small_gaps: dict[str, Any]
    missing_pictures: list[MissingRow]
    warnings: list[str]


@dataclass(frozen=True, slots=True)
class CoverageResult:
    """The latest result.

    Attributes:
        document: shares, and gaps with their causes, as JSON values. gaps: as `orthoswarm coverage` writes them.
        png: the states of the cells, empty while there is no area. placed: the pictures that are placed.
    """

    document: CoverageDocument
    gaps: dict[str, Any]
    png: bytes
    placed: list[View]


_NOTHING: Final = CoverageResult(
    {
        "state": "no area", "version": 0, "plan": None, "seen_share": None, "poor_share": None, "missed_share": None,
        "planned_share": None, "gaps": [], "missing_pictures": [], "offers": [], "warnings": [],
    },
    {"type": "FeatureCollection", "features": []}, b"", [],
)  # fmt: skip


class LiveCoverage(Background):
    """Updates the coverage.

    Args:
        views: of the workspace's pictures. console, plans: the operator's plan, and the folder of all plans: these say
            what the area is. drawer: knows the map's grid. on_links: rows of the vehicles there, at most half a second
            old. exposures: reported by them.

    Attributes:
        result: of the last search for gaps. seconds: its duration. battery: remaining flight time of the vehicles.
    """

    def __init__(
        self, journal: Journal, events: Events, *, views: PictureViews, console: ConsoleState, plans: Path,
        drawer: Drawer, on_links: Callable[[], Rows], exposures: ExposureJournal,
    ) -> None:  # fmt: skip
        super().__init__("coverage", join_s=None)
        self._journal, self._events, self._views = journal, events, views
        self._console, self._plans, self._drawer, self._on_links = console, plans, drawer, on_links
        self._exposures = exposures
        self._fresh: deque[tuple[View, PictureQuality | None]] = deque()
        self._bell = threading.Event()
        self._followed: _Followed | None = None
        self.result = _NOTHING
        self._version = 0
        self._rest_until = 0.0
        self._refused: AreaSource | None = None
        self._due: NDArray[np.bool_] | bool = False
        self.seconds = 0.0
        self.battery = BatteryUse()

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        self._bell.set()
        super().close()

    def picture_drawn(self, event: PictureDrawn) -> None:
        """Take a picture that is on the real-time layer; any thread."""
        self._fresh.append((View.of_frame(event.placed), event.quality))
        self._bell.set()

    def look(self, _: object = None) -> None:
        """Look now, since pictures were placed; any thread."""
        self._bell.set()

    @property
    def no_fly(self) -> dict[str, Any] | None:
        """The area's no-fly zones as GeoJSON, None if there are none."""
        here = self._followed
        if here is None or here.covered.area.no_fly.is_empty:
            return None
        return zone_features(here.covered.area)

    def planning_fovs_deg(self, heights_over_level_ground: bool) -> dict[str, float]:
        """Vehicle with placed pictures -> field of view to plan with, as `planning_fov_rad` has it, degrees."""
        return planning_fovs_deg(self.result.placed, heights_over_level_ground=heights_over_level_ground)

    # -- the thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        changed = True
        while not self._stop.is_set():
            try:
                changed = self._take() or changed
                if changed and time.monotonic() >= self._rest_until:
                    self._find()
                    changed = False
            except (OrthoSwarmError, sqlite3.Error) as error:  # a full disk or an incomplete file: tried again
                _log.warning("coverage: %s", error)
            self._bell.wait(_LOOK_S)
            self._bell.clear()

    def _take(self) -> bool:
        """Process new data; returns whether anything has changed."""
        changed = self._exposures.write()
        source = area_source(self._console.plan(), self._plans)
        if source is None or source == self._refused:
            self._fresh.clear()
            gone, self._followed, self.result = self._followed is not None, None, _NOTHING
            return gone
        epsg = None if self._drawer.area is None else self._drawer.area.epsg
        here = self._followed
        if here is None or here.source != source or (epsg is not None and here.cover.cells.grid.epsg != epsg):
            here = self._followed = self._begin(source, epsg)
            if here is None:
                return True
            changed = True
        fresh = [self._fresh.popleft() for _ in range(len(self._fresh))]
        changed |= self._put_recorded(here, fresh)
        placed, dropped = self._views.placed_anew(here.cover.cells.grid.epsg)
        if placed or dropped:
            here.cover.put(_with_flaws(placed, here.flaws), dropped)
            changed = True
        return self._follow(here) or changed

    def _begin(self, source: AreaSource, epsg: int | None) -> _Followed | None:
        """Start with an area, adding all pictures of the workspace."""
        try:
            covered = read_covered_area(source, None if epsg is None else LocalGrid(epsg))
            area = covered.area
            west, south, east, north = area.ground.bounds
            cell = max(1.0, np.ceil(10.0 * np.sqrt((east - west) * (north - south) / _MOST_CELLS)) / 10.0)
            cells = Cells.of_area(area.grid.epsg, area.ground, area.no_fly, float(cell))
        except InputError as error:
            self._refused = source
            _log.warning("no coverage: %s", error)
            return None
        flight = covered.flight
        reach_m, ahead_m = (0.0, 0.0) if flight is None else (0.25 * flight.width_m, flight.height_m)
        legs = FlownLegs(legs=covered.legs, reach_m=reach_m, ahead_m=ahead_m)
        here = _Followed(
            source=source, covered=covered, legs=legs, cover=CoverageGrid(cells), recorded=CoverageGrid(cells)
        )
        stored = self._journal.fact(_FACT) or {}
        if stored.get("plan") == covered.plan and covered.plan is not None:
            here.legs.resume(stored)
            here.stored = here.legs.state()
        self._views.forget()
        for pictures in self._views.recorded(area.grid):
            self._put_recorded(here, pictures)
            if self._stop.is_set():
                break
        last_s = last_drawn_arrival(self._journal)
        if last_s is not None:
            here.legs.picture_came(last_s)
        return here

    def _put_recorded(self, here: _Followed, pictures: Measured) -> bool:
        if not pictures:
            return False
        here.flaws.add(pictures)
        doubtful = here.flaws.judged()
        views = _with_flaws((view for view, _ in pictures), here.flaws)
        before = [v for v in here.cover.views if (v.vehicle, v.image) in doubtful]
        here.cover.put(_with_flaws(before, here.flaws))
        placed = {(v.vehicle, v.image) for v in here.cover.views if v.placed}
        here.cover.put(v for v in views if (v.vehicle, v.image) not in placed)
        here.recorded.put(views)
        for view in sorted(views, key=lambda v: v.time_s or 0.0):
            here.legs.pass_by(view.vehicle, float(view.position[0]), float(view.position[1]))
        here.legs.picture_came(time.time())
        return True

    def _follow(self, here: _Followed) -> bool:
        """Track the vehicles; returns whether the due cells have changed."""
        rows = self._on_links()
        grid = here.covered.area.grid
        for row in rows:
            self.battery.look(row, flies(row), time.monotonic())
            lat, lon = row.get("lat_deg"), row.get("lon_deg")
            if lat is not None and lon is not None and row["armed"]:
                east, north = grid.to_grid(lat, lon)
                here.legs.pass_by(str(row["id"]), float(east), float(north))
        here.legs.look(rows)
        state = here.legs.state()
        if here.covered.plan is not None and state != here.stored:
            self._journal.remember(_FACT, {"plan": here.covered.plan, **state})
            here.stored = state
        due = self._due_cells(here, rows)
        changed = not np.array_equal(due, self._due)
        self._due = due
        return changed

    def _due_cells(self, here: _Followed, rows: Rows) -> "NDArray[np.bool_] | bool":
        """Cells that should be covered by now: below finished legs, and not below a leg that is still to be flown."""
        if here.legs.all_over(rows, time.time()):
            return True
        over, flight = here.legs.over, here.covered.flight
        if flight is None or not over.any():
            return False
        if not np.array_equal(over, here.over) or isinstance(self._due, bool):
            here.over = over
            cells = here.cover.cells
            due = below_legs(cells, flight, flight.legs[over])
            return due & ~below_legs(cells, flight, flight.legs[~over])
        return self._due

    # -- what is found --------------------------------------------------------------------------------------------

    def _find(self) -> None:
        here = self._followed
        began, cpu = time.monotonic(), time.thread_time()
        self._version += 1
        self.result = _NOTHING if here is None else self._found(here)
        self.seconds = time.monotonic() - began
        self._rest_until = time.monotonic() + _LEAST_PAUSE * (time.thread_time() - cpu)
        found = self.result.document
        told: dict[str, Any] = {key: found[key] for key in _TOLD}
        self._events.tell("coverage", gaps=len(found["gaps"]), **told)

    def _found(self, here: _Followed) -> CoverageResult:
        cover, grid = here.cover, here.covered.area.grid
        missing, doubts = self._missing(here)
        gaps = find_gaps(cover, missing, here.covered.flight, due=self._due)
        features = [gap_feature(gap, grid) for gap in gaps.gaps]
        states = cover.states(self._due)
        placed = [v for v in cover.views if v.placed]
        document: CoverageDocument = {
            "state": "complete" if self._due is True else "in flight" if cover.views else "planned",
            "version": self._version, "time": iso_time(time.time()),
            "plan": here.covered.plan, **_shares(cover.shares(self._due)),  # type: ignore[typeddict-item]
            "recorded": _shares(here.recorded.shares(self._due)),
            "pictures": {"placed": len(placed), "recorded": len(cover.views) - len(placed)},
            "area_m2": cover.cells.area_m2, "cell_m": cover.cells.grid.gsd_m,
            "offers": _offers(here.legs, states, cover.cells.grid),
            "legs": {"planned": len(here.legs.flown), "over": int(here.legs.over.sum())},
            "corners": picture_corners(cover.cells.grid, states),
            "gaps": [f["properties"] | {"polygon": f["geometry"]} for f in features],
            "small_gaps": {"count": gaps.small, "area_m2": round(gaps.small_m2, 1)},
            "missing_pictures": _missing_rows(missing), "warnings": [*_warnings(cover), *doubts],
        }  # fmt: skip
        return CoverageResult(document, {"type": "FeatureCollection", "features": features}, cells_png(states), placed)

    def _missing(self, here: _Followed) -> tuple[list[MissingPicture], list[str]]:
        """Missing pictures, and doubts about the camera events."""
        grid = here.covered.area.grid
        events = self._exposures.events(grid)
        if self._due is not True:  # pictures of the newest ones may still arrive
            last = max((event.time_s for event in events), default=0.0) - _ON_THE_WAY_S
            events = [event for event in events if event.time_s <= last]
        return missing_by_events(here.cover.views, events, self._views.rejected())


def _with_flaws(views: Iterable[View], flaws: FlawedPictures) -> list[View]:
    return [replace(v, flaws=flaws.of((v.vehicle, v.image))) for v in views]


def _shares(shares: Shares) -> dict[str, float]:
    return {
        "seen_share": shares.seen, "poor_share": shares.poor, "missed_share": shares.missed,
        "planned_share": shares.planned,
    }  # fmt: skip


def _offers(legs: FlownLegs, states: NDArray[np.uint8], grid: GroundGrid) -> list[dict[str, Any]]:
    """Unflown legs of vehicles that have left their mission, to be flown by others: a row per vehicle.

    Legs whose ground has been seen meanwhile, in another's flight, are left out.
    """
    rows = []
    for vehicle, unflown in legs.remaining().items():
        left = [leg for leg in unflown if _is_unseen(legs.legs.ends[leg], states, grid)]
        if left:
            length_m = float(np.hypot(*(legs.legs.ends[left, 1] - legs.legs.ends[left, 0]).T).sum())
            rows.append({"vehicle": vehicle, "legs": len(left), "length_m": round(length_m, 1)})
    return rows


def _is_unseen(ends: NDArray[np.float64], states: NDArray[np.uint8], grid: GroundGrid) -> bool:
    """True if a cell below a leg was not seen, or none is in the area; `ends` are two points, metres of the grid."""
    steps = np.linspace(0.0, 1.0, 2 + int(np.hypot(*(ends[1] - ends[0])) / grid.gsd_m))
    east, north = (ends[0] + steps[:, None] * (ends[1] - ends[0])).T
    rows, columns = ((grid.north - north) / grid.gsd_m).astype(int), ((east - grid.west) / grid.gsd_m).astype(int)
    inside = (rows >= 0) & (columns >= 0) & (rows < states.shape[0]) & (columns < states.shape[1])
    below = states[rows[inside], columns[inside]]
    below = below[below != CellState.OUTSIDE]
    return bool(not below.size or np.isin(below, (CellState.MISSED, CellState.PLANNED)).any())


def _missing_rows(missing: Sequence[MissingPicture]) -> list[MissingRow]:
    return [
        {"vehicle": m.view.vehicle, "image": m.view.image, "after": m.after, "cause": str(m.cause),
         "confidence": round(m.confidence, 2), "time_s": m.view.time_s}
        for m in missing
    ]  # fmt: skip


def _warnings(cover: CoverageGrid) -> list[str]:
    found = []
    if cover.views and not (cover.best[cover.cells.wanted] != 255).any():
        found.append("no picture sees any of the area: check that the area and the flight belong together")
    if cover.cells.grid.gsd_m > 1.0:
        found.append(f"the area is large: its cells are {cover.cells.grid.gsd_m:g} m wide; plan it in parts for 1 m")
    return found


def cells_png(states: NDArray[np.uint8]) -> bytes:
    """A PNG with a palette, uint8 (rows, columns) of CellState; large areas are reduced without losing gaps."""
    from PIL import Image

    step = -(-max(states.shape) // _LARGEST_PX)
    if step > 1:
        rows, columns = (-(-side // step) * step for side in states.shape)
        padded = np.zeros((rows, columns), np.uint8)
        padded[: states.shape[0], : states.shape[1]] = states
        blocks = padded.reshape(rows // step, step, columns // step, step)
        states = np.zeros((rows // step, columns // step), np.uint8)
        for state in reversed(_SHOWN_FIRST):
            states[(blocks == state).any((1, 3))] = state
    picture = Image.fromarray(states, "P")
    table = [COLOURS[state] for state in CellState]
    picture.putpalette([value for red, green, blue, _ in table for value in (red, green, blue)])
    out = io.BytesIO()
    picture.save(out, "PNG", transparency=bytes(alpha for *_, alpha in table))
    return out.getvalue()


def picture_corners(grid: GroundGrid, states: NDArray[np.uint8]) -> list[list[float]]:
    """Longitude and latitude of the picture's corners: top left, top right, bottom right, bottom left."""
    step = -(-max(states.shape) // _LARGEST_PX)
    rows, columns = (-(-side // step) * step * grid.gsd_m for side in states.shape)
    east, south = grid.west + columns, grid.north - rows
    corners = [[grid.west, grid.north], [east, grid.north], [east, south], [grid.west, south]]
    return [[round(float(lon), 8), round(float(lat), 8)] for lat, lon in LocalGrid(grid.epsg).to_geographic(corners)]
