"""Views of a workspace's pictures: recorded poses as drawn, placed poses from the solution files; flaws."""

import bisect
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from gcs_plugin.daemon.intake.posted_pose import frame_of_row
from gcs_plugin.daemon.jobs.solution_file import SolutionFileError, read_solution
from gcs_plugin.daemon.store.frame_rows import drawn_frames, rejected_frames
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.picture_store import PictureStore
from gcs_plugin.daemon.store.sortie_rows import solution_paths
from orthoswarm.coverage.missing_pictures import Exposure
from orthoswarm.coverage.view import NEIGHBOURS, NO_FLAW, Flaw, View, picture_flaws
from orthoswarm.model.geo import LocalGrid
from orthoswarm.mosaic.recorded_pose import recorded_cameras
from orthoswarm.raster.picture_quality import PictureQuality

Key = tuple[str, str]
Measured = Sequence[tuple[View, PictureQuality | None]]
"""Views with what the pixels of their pictures say."""
_AT_ONCE: Final = 500  # rows of the journal that are read in one go
_NO_TIME: Final = 0.0


class PictureViews:
    """Reads views from a workspace."""

    def __init__(self, journal: Journal, store: PictureStore, solutions: Path, fov_rad: float | None) -> None:
        self._journal, self._store, self._folder, self._fov_rad = journal, store, solutions, fov_rad
        self._read: dict[tuple[str, str, int], str] = {}

    def recorded(self, grid: LocalGrid) -> Iterator[Measured]:
        """Views of all pictures on the real-time layer as recorded, in chunks, in the order of arrival."""
        last = 0
        while rows := drawn_frames(self._journal, last, _AT_ONCE):
            last = rows[-1].seq
            part = []
            for row in rows:
                placed = recorded_cameras([frame_of_row(row, self._store)], grid, self._fov_rad).placed
                part += [(View.of_frame(found), row.quality) for found in placed]
            yield part

    def placed_anew(self, epsg: int) -> tuple[list[View], list[Key]]:
        """Views placed since the last call, and pictures that a refinement could not place.

        A refined sortie replaces its placements in flight. Files that are being replaced are read at the next call.
        """
        views: list[View] = []
        dropped: list[Key] = []
        refined = solution_paths(self._journal, "solutions")
        for whose, path in (solution_paths(self._journal, "coarse") | refined).items():
            key = str(epsg), *whose
            if self._read.get(key) == path:
                continue
            try:
                found = read_solution(self._folder / path)
            except SolutionFileError:
                continue
            self._read[key] = path
            solution, ground = found.solution, found.terrain
            half = 0.5 * math.radians(solution.fov_deg)
            # d(f)/f of f = (W/2) / tan(half): d(half) / (sin(half) cos(half))
            focal = math.radians(solution.fov_sigma_deg) / math.sin(2.0 * half)
            focal = focal if math.isfinite(focal) else 0.0
            views += [
                replace(View.of_frame(p, focal_sigma=focal, ground=ground), vehicle=whose[0], placed=True)
                for p in solution.placed
            ]
            if whose in refined:
                dropped += [(whose[0], image) for image in solution.dropped]
        return views, dropped

    def rejected(self) -> list[Exposure]:
        """Pictures that arrived and could not be used."""
        return [Exposure(*row) for row in rejected_frames(self._journal)]

    def forget(self) -> None:
        """Make `placed_anew` return everything again."""
        self._read.clear()


class FlawedPictures:
    """Flaws of pictures; they can change until the following pictures have arrived."""

    def __init__(self) -> None:
        self._cameras: dict[tuple[str, int, int], list[tuple[float, str, PictureQuality]]] = {}
        self._first: dict[tuple[str, int, int], int] = {}
        self._flaws: dict[Key, Flaw] = {}

    def add(self, pictures: Iterable[tuple[View, PictureQuality | None]]) -> None:
        """Add pictures as they arrive; one without a measurement (None) has no flaw."""
        for view, quality in pictures:
            if quality is None:
                continue
            camera = view.vehicle, view.lens.width, view.lens.height
            row = self._cameras.setdefault(camera, [])
            entry = (view.time_s if view.time_s is not None else _NO_TIME, view.image, quality)
            at = bisect.bisect_left(row, entry[:2], key=lambda e: e[:2])
            if at < len(row) and row[at][:2] == entry[:2]:
                row[at] = entry  # drawn a second time
            else:
                row.insert(at, entry)
            self._first[camera] = min(at, self._first.get(camera, at))

    def judged(self) -> set[Key]:
        """Assess pictures that arrived since the last call; returns vehicle and image of those with changed flaws."""
        changed = set()
        for camera, first in self._first.items():
            row = self._cameras[camera]
            reach = NEIGHBOURS
            begin = max(0, first - 2 * reach)  # the median for the first one needs those before it
            found = picture_flaws([quality for *_, quality in row[begin:]])
            for k in range(max(0, first - reach), len(row)):
                key = camera[0], row[k][1]
                if self._flaws.get(key, NO_FLAW) != found[k - begin]:
                    self._flaws[key] = found[k - begin]
                    changed.add(key)
        self._first.clear()
        return changed

    def of(self, key: Key) -> Flaw:
        """The flaws of a picture, by vehicle and image."""
        return self._flaws.get(key, NO_FLAW)
