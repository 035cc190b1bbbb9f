"""Finds pictures that are blurred, damaged or without contrast compared with their neighbours, as they arrive."""

import bisect
from collections.abc import Iterable
from typing import Final

from orthoswarm.coverage.picture_flaws import NEIGHBOURS, picture_flaws
from orthoswarm.coverage.view import NO_FLAW, Flaw, View
from orthoswarm.raster.picture_quality import PictureQuality

Key = tuple[str, str]
_NO_TIME: Final = 0.0


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
