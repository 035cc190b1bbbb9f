"""Findings about an input, with a code for programs and a sentence for people."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One observation about a source."""

    code: str  # stable, lower case with hyphens
    message: str  # one plain sentence, with what was done about it
    vehicle: str = ""  # the vehicle concerned, "" for all
    note: bool = False  # True for information that is not an error

    def __str__(self) -> str:
        return f"{self.vehicle}: {self.message}" if self.vehicle else self.message


def metres(distance_m: float) -> str:
    """A distance as text, in kilometres if it is long."""
    return f"{distance_m / 1000:.0f} km" if distance_m > 10_000 else f"{distance_m:.0f} m"


def plural(count: int, noun: str) -> str:
    """A count with its noun, as in 1 photo, 3 photos."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
