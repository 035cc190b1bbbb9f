"""Which of a vehicle's files is the picture of a camera event, by the numbers in their names."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

_SURE: Final = 0.9  # share of the pictures that agree on the shift of numbers
_LEAST: Final = 3  # pictures for it
_PICTURES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")


@dataclass(slots=True)
class PictureNames:
    """The pictures of a vehicle that have arrived.

    Attributes:
        images: their names. shift: number of a file less that of its camera event; None if there is no such number.
    """

    images: set[str] = field(default_factory=set)
    shift: int | None = 0

    @staticmethod
    def of(pictures: Iterable[tuple[str, float]], events: Iterable[tuple[int, float]]) -> "PictureNames":
        """From arrived pictures (name, UTC seconds) and camera events (number, UTC seconds).

        Each picture belongs to the event nearest in time, within half of the usual time between events. The shift is
        0 while fewer than three pictures have arrived, and None if the differences of the numbers vary.
        """
        arrived, exposed = list(pictures), sorted(events, key=lambda event: event[1])
        images = {image for image, _ in arrived}
        times = np.array([time_s for _, time_s in exposed])
        if len(times) < 2:
            return PictureNames(images)
        slack_s = 0.5 * float(np.median(np.diff(times)))
        shifts: Counter[int] = Counter()
        for image, time_s in arrived:
            nearest = int(np.abs(times - time_s).argmin())
            number = number_of(image)
            if number is not None and abs(times[nearest] - time_s) <= slack_s:
                shifts[number - exposed[nearest][0]] += 1
        if shifts.total() < _LEAST:
            return PictureNames(images)
        shift, count = shifts.most_common(1)[0]
        return PictureNames(images, shift if count >= _SURE * shifts.total() else None)

    def find(self, number: int, files: Mapping[str, int]) -> tuple[str, str]:
        """The path of an event's picture among a vehicle's files, and why there is none ("" where there is one)."""
        if self.shift is None:
            return "", "the numbers of its files do not match those of its camera events"
        pictures = [path for path in files if path.lower().endswith(_PICTURES)]
        if self.images:
            forms = {_form(image) for image in self.images}
            same_form = [path for path in pictures if _form(path) in forms]
            if pictures and not same_form:
                return "", "its files have other names than the pictures that have arrived"
            pictures = same_form
        found = [path for path in pictures if number_of(path) == number + self.shift]
        same = [path for path in found if path.rpartition("/")[0] in self._folders(files)]
        found = same or found
        if len(found) > 1:
            return "", f"several of its files have number {number + self.shift}"
        return (found[0], "") if found else ("", f"it has no picture file with number {number + self.shift}")

    def _folders(self, files: Mapping[str, int]) -> set[str]:
        """The folders with pictures that have arrived."""
        return {path.rpartition("/")[0] for path in files if path.rpartition("/")[2] in self.images}


def _form(name: str) -> str:
    """A name without its numbers: `img_#.jpg`."""
    return re.sub(r"\d+", "#", name.rpartition("/")[2].lower())


def number_of(name: str) -> int | None:
    """The last number in a file's name."""
    digits = re.findall(r"\d+", name.rpartition("/")[2])
    return int(digits[-1]) if digits else None
