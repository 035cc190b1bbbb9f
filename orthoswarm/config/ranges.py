"""Which numbers a threshold may be: from the unit at the end of its name and its default, or declared beside it.

A share lies between 0 and 1, an angle within a full turn, a field of view below 180 degrees; lengths, times, sizes and
counts are above 0. 0 is allowed only where the default is 0 or the field says so (`from_zero`): most thresholds divide
by something, or count what there must be one of.
"""

import sys
from collections.abc import Iterator
from dataclasses import Field, dataclass, field
from typing import Any, Final, TypeVar

Value = TypeVar("Value", int, float, tuple[float, float])

_KEY: Final = "zero is allowed"
_SHARES: Final = ("share", "overlap")
_TOPS: Final = {"percent": 100.0, "deg": 360.0}
_LARGEST: Final = sys.float_info.max
_LARGEST_WHOLE: Final = 2**31 - 1
"""Compiled code and OpenCV count with 32 bits."""


@dataclass(frozen=True, slots=True)
class Range:
    """Finite numbers from `least` to `most`; with `above` and `below` the end itself is left out."""

    least: float
    most: float
    above: bool = False
    below: bool = False

    def __contains__(self, value: float) -> bool:
        enough = value > self.least if self.above else value >= self.least
        return enough and (value < self.most if self.below else value <= self.most)

    def __str__(self) -> str:
        """What is allowed, to follow "a number"."""
        parts = [f"{'above' if self.above else 'of at least'} {self.least:g}"]
        if self.most == _LARGEST_WHOLE:
            parts.append(f"at most {_LARGEST_WHOLE}")
        elif self.most != _LARGEST:
            parts.append(f"{'below' if self.below else 'at most'} {self.most:g}")
        return " and ".join(parts)


def from_zero(default: Value) -> Value:
    """A field that may be 0, "none of it", though its default is not."""
    return field(default=default, metadata={_KEY: True})


def above_zero(default: Value) -> Value:
    """A share that may not be 0: something is divided by it."""
    return field(default=default, metadata={_KEY: False})


def range_of(declared: "Field[Any]") -> Range | None:
    """The numbers that a field of a configuration may be (in a tuple each of them), None if it holds none."""
    numbers = list(numbers_in(declared.default))
    if not numbers:
        return None
    smallest, largest = min(numbers), max(numbers)
    unit = declared.name.rpartition("_")[2]
    share = unit in _SHARES and largest < 1.0  # with a larger default it is a factor, and 1.0 may be exceeded
    whole = all(isinstance(number, int) for number in numbers)
    lens, nadir = declared.name.endswith("fov_deg"), declared.name.endswith("nadir_deg")  # which looks at ground
    most = _LARGEST_WHOLE if whole else _LARGEST
    most = 180.0 if lens else 90.0 if nadir else 1.0 if share else _TOPS.get(unit, most)
    below = lens or nadir or (share and unit == "overlap")
    above = not declared.metadata.get(_KEY, share or smallest == 0)
    return Range(1, most, below=below) if above and whole else Range(0, most, above, below)


def rises(declared: "Field[Any]") -> bool:
    """True for a pair whose second number is the larger one: the bounds of something."""
    numbers = list(numbers_in(declared.default))
    return len(numbers) == 2 and numbers[0] < numbers[1]


def numbers_in(value: Any) -> Iterator[int | float]:
    """The numbers of a value; those of a tuple and of tuples in it one after the other."""
    if isinstance(value, tuple):
        for part in value:
            yield from numbers_in(part)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value
