"""The flight that a plan's folder describes, as the coverage compares it with what was flown."""

import json
import math
from pathlib import Path

import numpy as np

from orthoswarm.coverage.gaps import PlannedFlight
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid


def read_planned_flight(folder: Path, grid: LocalGrid) -> PlannedFlight:
    """Legs and footprint of a folder that `orthoswarm plan` wrote (plan.json, all.geojson).

    Args:
        folder: the plan's folder. grid: in which the legs are wanted.

    Raises:
        InputError: the folder is not a plan's.
    """
    try:
        figures = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        features = json.loads((folder / "all.geojson").read_text(encoding="utf-8"))["features"]
        width, height = (float(side) for side in figures["footprint_m"])
        fov = math.radians(float(figures["fov_min_deg"]))
        # A leg over hills has several points; only its ends matter here.
        lines = [f["geometry"]["coordinates"] for f in features if f["properties"].get("kind") == "leg"]
        ends = np.array([[line[0][:2], line[-1][:2]] for line in lines], float).reshape(-1, 2, 2)
    except OSError as error:
        raise InputError(
            f"{folder} is not the folder of a plan ({error.strerror}); give the --out of `orthoswarm plan`"
        ) from None
    except (ValueError, KeyError, TypeError, IndexError):
        raise InputError(f"{folder} holds a broken plan.json or all.geojson; plan again") from None
    legs = grid.to_grid(ends[..., 1], ends[..., 0])
    return PlannedFlight(legs, width, height, fov)
