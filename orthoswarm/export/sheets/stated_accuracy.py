"""What a map's report says about its accuracy, and about pictures that are not refined, in a few sentences."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthoswarm.export.product_files import read_frames


@dataclass(frozen=True, slots=True)
class StatedAccuracy:
    """The accuracy of a map."""

    sentence: str  # for people
    values: dict[str, float | int | str]  # for programs, lengths in metres


_LAYERS = ("orthoimage", "coarse", "realtime")  # from the last stage to the first


def stated_accuracy(folder: Path, layer: str = "") -> StatedAccuracy | None:
    """What placed a map, the sigma that its pictures state, and the errors at surveyed points where it was checked.

    From `report.json`; sigma from `frames.jsonl`, or from the report's legs where that has none. Both describe the last
    stage: of an earlier one it is only said how it was placed.

    Args:
        folder: of the map. layer: "orthoimage", "coarse" or "realtime"; "" for the last that is there.

    Returns:
        None if there is no report.
    """
    path = folder / "report.json"
    if not path.exists():
        return None
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if _is_earlier(folder, layer, report):
        return _of_earlier(layer, _matched(report))
    placed_on, placing = _placed(report)
    sigma, of_sigma = _sigma(_sigmas(folder, report), placed_on)
    checked, of_check = _checked(report)
    parts = [_unrefined(report.get("unrefined", {})), placing, sigma, checked]
    values: dict[str, float | int | str] = {"orthoswarm:placed_on": placed_on, **of_sigma, **of_check}
    return StatedAccuracy(" ".join(part for part in parts if part), values)


def _is_earlier(folder: Path, layer: str, report: Mapping[str, Any]) -> bool:
    """Whether a layer is of an earlier stage than the one that the report describes."""
    there = (name for name in _LAYERS if any((folder / f"{name}.{kind}").exists() for kind in ("tif", "vrt")))
    last = next(there, layer)
    copied = (last, layer) == ("orthoimage", "coarse") and report.get("basemap") is None
    return layer in _LAYERS and layer != last and not copied


def _of_earlier(layer: str, matched: int) -> StatedAccuracy:
    if layer == "realtime":
        how, placed_on = "The quick picture, not refined: placed as the receivers recorded.", "receivers"
    else:
        how, placed_on = "The coarse picture, before the last refinement.", "map" if matched else "receivers"
    return StatedAccuracy(f"{how} No accuracy is stated for it.", {"orthoswarm:placed_on": placed_on})


def _matched(report: Mapping[str, Any]) -> int:
    """How many legs were found on the map."""
    return sum(leg.get("state") == "matched" for leg in report.get("legs", []))


def _placed(report: Mapping[str, Any]) -> tuple[str, str]:
    """What placed the map: a word, and a sentence."""
    matched = _matched(report)
    on_map = f"{matched} of {len(report.get('legs', []))} legs were found on the map"
    control = report.get("control")
    if control:
        count = int(control["points"])
        points = "1 control point" if count == 1 else f"{count} control points"
        return "control points", f"{on_map}, which {points} corrected." if matched else f"Placed on {points}."
    if matched:
        doubted = (report.get("map_offset_m") or {}).get("doubted")
        doubt = " The map and the receivers disagree: see the report." if doubted else ""
        return "map", f"{on_map}.{doubt}"
    if report.get("until") == "realtime" or report.get("refine") == "none":
        return "receivers", "Not refined: placed as the receivers recorded."
    return "receivers", "No leg was found on a map: placed where the receivers say."


def _sigmas(folder: Path, report: Mapping[str, Any]) -> list[float]:
    """One standard deviation of an axis, of each picture or, where they state none, of each leg."""
    lines = folder / "frames.jsonl"
    stated = [row.get("sigma_m") for row in read_frames(lines)] if lines.exists() else []
    found = _finite(stated)
    return found or _finite([leg.get("sigma_m") for leg in report.get("legs", [])])


def _finite(values: Sequence[Any]) -> list[float]:
    return [float(v) for v in values if v is not None and math.isfinite(v)]


def _sigma(sigmas: Sequence[float], placed_on: str) -> tuple[str, dict[str, float]]:
    if not sigmas:
        return "", {}
    typical, worst = statistics.median(sigmas), max(sigmas)
    largest = f", largest {worst:.2f} m" if f"{worst:.2f}" != f"{typical:.2f}" else ""
    against = " against it" if placed_on == "map" else ""
    sentence = f"Expected error{against}: {typical:.2f} m (one sigma an axis; median of the pictures{largest})."
    return sentence, {"orthoswarm:sigma_median_m": typical, "orthoswarm:sigma_most_m": worst}


def _checked(report: Mapping[str, Any]) -> tuple[str, dict[str, float | int]]:
    """The errors at surveyed points; points that also placed the map are named, since they say less."""
    found = report.get("checkpoints")
    if not found:
        return "Not checked at surveyed points.", {}
    count = int(found["checkpoints"])
    total = math.hypot(float(found["rmse_h_m"]), float(found.get("survey_rmse_h_m") or 0.0))
    placing = {row["name"] for row in (report.get("control") or {}).get("residuals", [])}
    both = len(placing & {row["name"] for row in found.get("points", [])})
    also = f", {both} of which placed it" if both else ""
    points = "1 checkpoint" if count == 1 else f"{count} checkpoints"
    return f"RMSE_H at {points}{also}: {total:.2f} m, survey's error included.", {
        "orthoswarm:rmse_h_m": total,
        "orthoswarm:checkpoints": count,
    }


def _unrefined(pictures: Mapping[str, int]) -> str:
    """A sentence about pictures that lie as their vehicles recorded them; `pictures`: vehicle -> how many."""
    if not pictures:
        return ""
    rows = ", ".join(f"{count} of {vehicle}" for vehicle, count in sorted(pictures.items()))
    return f"Not refined when this was written, and metres off: pictures {rows}."
