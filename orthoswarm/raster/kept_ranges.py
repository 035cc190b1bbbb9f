"""The values that a ground station's 16-bit pictures use: kept beside them, as its folders mix cameras and grow.

A range is found for pictures of one size and format, which tells cameras apart. It comes from the first picture, and
grows with those that use more.
"""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Range = tuple[float, float]

FILE: Final = "ranges.json"
STRETCH_PERCENT: Final = (0.5, 99.5)
"""Percentiles of a map or pictures of more than 8 bits that become 0 and 255 (usual in GIS: 2 and 98, which clips
roofs)."""
_MARGIN: Final = 0.1
"""Share of its width by which a range grows beyond a picture that leaves it: so it grows seldom (chosen)."""
_DEPTH_FULL: Final = 32768.0
"""16-bit pictures whose upper values (`STRETCH_PERCENT`) reach this use all bits: 256 of their levels become one.
Others, with 10 to 14 bits, are stretched like maps (half of the range)."""
_DEPTH_VALUES: Final = 20_000  # about so many values of each of them (for its time)


def limits(pictures: list[NDArray[Any]]) -> Range | None:
    """Values that become 0 and 255 in pictures; None where they use all 16 bits."""
    values = [picture.ravel()[:: max(1, picture.size // _DEPTH_VALUES)] for picture in pictures]
    low, high = np.nanpercentile(np.concatenate(values).astype(np.float64), STRETCH_PERCENT)
    return (float(low), float(max(high, low + 1.0))) if high < _DEPTH_FULL else None


def kept_range(store: Path, picture: NDArray[Any], suffix: str) -> Range | None:
    """The range kept for a picture's kind; None where none is kept or all 16 bits are used."""
    found = read_ranges(store).get(_kind(picture, suffix))
    return None if found is None else (float(found[0]), float(found[1]))


def read_ranges(store: Path) -> dict[str, Any]:
    """What `grown` returned last and somebody has written to `FILE`; empty if that cannot be read."""
    try:
        document = json.loads((store / FILE).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}


def grown(ranges: dict[str, Any], picture: NDArray[Any], suffix: str) -> dict[str, Any] | None:
    """The ranges with that of one more picture; None if they hold it already."""
    kind, used = _kind(picture, suffix), limits([picture])
    if kind not in ranges:
        return ranges | {kind: used}
    kept = ranges[kind]
    if kept is None or (used is not None and kept[0] <= used[0] and used[1] <= kept[1]):
        return None
    if used is None:
        return ranges | {kind: None}
    low, high = min(kept[0], used[0]), max(kept[1], used[1])
    more = _MARGIN * (high - low)
    return ranges | {kind: (low - more * (used[0] < kept[0]), high + more * (used[1] > kept[1]))}


def _kind(picture: NDArray[Any], suffix: str) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}{suffix}"
