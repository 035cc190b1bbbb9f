"""What a map's report says about its accuracy, in one sentence."""

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
    """From the legs in a map's `report.json`: their own estimate, not a comparison with survey points.

    Returns:
        None if there is no report, or no leg was found on the map.
    """
    path = folder / "report.json"
    if not path.exists():
        return None
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    legs = report.get("legs", [])
    sigmas = [float(leg["sigma_m"]) for leg in legs if leg.get("state") == "matched" and leg.get("sigma_m") is not None]
    if not sigmas:
        return None
    typical, worst = statistics.median(sigmas), max(sigmas)
    sentence = (
        f"{len(sigmas)} of {len(legs)} legs were found on the map; by their own estimate half of them lie within "
        f"{typical:.2f} m of it, all within {worst:.2f} m (one standard deviation). Not checked against survey points."
    )
    return StatedAccuracy(sentence, {"orthoswarm:sigma_median_m": typical, "orthoswarm:sigma_most_m": worst})
