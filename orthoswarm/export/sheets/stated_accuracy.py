"""What a map's report says about its accuracy, and about pictures that are not refined, in a few sentences."""

import json
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class StatedAccuracy:
    """The accuracy of a map.

    Attributes:
        sentence: for people. values: for programs, in metres.
    """

    sentence: str
    values: dict[str, float]


def stated_accuracy(folder: Path) -> StatedAccuracy | None:
    """From a map's `report.json`: the legs' own estimate, not a comparison with survey points, and `unrefined`.

    Returns:
        None if there is no report, or it says nothing of either.
    """
    path = folder / "report.json"
    if not path.exists():
        return None
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    sentence, values = _of_legs(report.get("legs", []))
    parts = [part for part in (_unrefined(report.get("unrefined", {})), sentence) if part]
    return StatedAccuracy(" ".join(parts), values) if parts else None


def _of_legs(legs: list[dict[str, Any]]) -> tuple[str, dict[str, float]]:
    """Sentence and values; empty if no leg was found on the map."""
    sigmas = [float(leg["sigma_m"]) for leg in legs if leg.get("state") == "matched" and leg.get("sigma_m") is not None]
    if not sigmas:
        return "", {}
    typical, worst = statistics.median(sigmas), max(sigmas)
    sentence = (
        f"{len(sigmas)} of {len(legs)} legs were found on the map; by their own estimate half of them lie within "
        f"{typical:.2f} m of it, all within {worst:.2f} m (one standard deviation). Not checked against survey points."
    )
    return sentence, {"orthoswarm:sigma_median_m": typical, "orthoswarm:sigma_most_m": worst}


def _unrefined(pictures: dict[str, int]) -> str:
    """A sentence about pictures that lie as their vehicles recorded them; `pictures`: vehicle -> how many."""
    if not pictures:
        return ""
    rows = ", ".join(f"{count} of {vehicle}" for vehicle, count in sorted(pictures.items()))
    return f"Not refined when this was written, and metres off: pictures {rows}."
