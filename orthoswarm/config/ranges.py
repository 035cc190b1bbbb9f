"""Which numbers a setting may be: from the unit at the end of its name and its kind, or declared beside it.

A share lies between 0 and 1; lengths, times, sizes and counts are above 0. 0 is allowed only where the field says so
(`from_zero`): most settings divide by something, or count what there must be one of.
"""

import sys
from dataclasses import Field, dataclass, field
from typing import Any, Final

_KEY: Final = "zero is allowed"
_LARGEST: Final = sys.float_info.max
_LARGEST_WHOLE: Final = 2**31 - 1
"""Compiled code and OpenCV count with 32 bits."""


@dataclass(frozen=True, slots=True)
class Range:
    """Finite numbers from `least` to `most`; with `above` the least itself is left out."""

    least: float
    most: float
    above: bool = False

    def __contains__(self, value: float) -> bool:
        return (value > self.least if self.above else value >= self.least) and value <= self.most

    def __str__(self) -> str:
        """What is allowed, to follow "a number"."""
        least = f"{'above' if self.above else 'of at least'} {self.least:g}"
        return least if self.most == _LARGEST else f"{least} and at most {self.most:.10g}"


def from_zero(default: float) -> Any:
    """A field that may be 0, "none of it"."""
    return field(default=default, metadata={_KEY: True})


def above_zero(default: float) -> Any:
    """A share that may not be 0, as something is divided by it, and may exceed 1."""
    return field(default=default, metadata={_KEY: False})


def range_of(declared: "Field[Any]") -> Range:
    """The numbers that a field of a configuration may be."""
    if isinstance(declared.default, int):
        return Range(1, _LARGEST_WHOLE)
    share = declared.name.endswith("_share") and _KEY not in declared.metadata
    return Range(0, 1.0 if share else _LARGEST, above=not declared.metadata.get(_KEY, share))
