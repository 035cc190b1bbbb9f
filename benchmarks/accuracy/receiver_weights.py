"""How receivers that place a block together should be weighed.

    python -m benchmarks.accuracy.receiver_weights

Made-up receivers drift evenly from 0 to up to 0.1 m a photo and axis, as the simulated flights' do, with or without a
bias of their own. A line for each number of vehicles, of photos each, and bias: error of the place that all receivers
give together (median over draws, metres), weighed alike, by a vehicle's drift, and by its drift in each axis.
"""

import argparse
import json

import numpy as np

from orthoswarm.refine.bundle.covariance import DRIFT_MEAN_SHARE, RECEIVER_BIAS_SIGMA_M

DRIFT_M = 0.1
"""Largest drift a photo, metres."""
DRAWS = 20_000


def errors(vehicles: int, photos: int, bias_m: float) -> dict[str, float]:
    """Median errors by way of weighing."""
    random = np.random.default_rng(0)
    end = random.uniform(-DRIFT_M, DRIFT_M, (DRAWS, vehicles, 2)) * (photos - 1)
    mean = 0.5 * end + random.normal(0.0, bias_m, end.shape)
    seen = end**2 / 12.0  # variance of an even drift about its mean: what pictures show
    known = RECEIVER_BIAS_SIGMA_M**2
    by_axis = known + DRIFT_MEAN_SHARE * seen
    by_vehicle = known + DRIFT_MEAN_SHARE * seen.mean(axis=2, keepdims=True)
    out = {}
    for name, variance in (("alike", np.ones_like(seen)), ("by_vehicle", by_vehicle), ("by_axis", by_axis)):
        weight = np.broadcast_to(1.0 / variance, mean.shape)
        place = (weight * mean).sum(axis=1) / weight.sum(axis=1)
        out[f"{name}_m"] = round(float(np.median(np.hypot(*place.T))), 2)
    return out


def main() -> None:
    """Print a line for each kind of flight."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for vehicles, photos in ((2, 60), (4, 60), (6, 30), (3, 339)):
        for bias_m in (0.0, RECEIVER_BIAS_SIGMA_M):
            row = {"vehicles": vehicles, "photos": photos, "bias_m": bias_m}
            print(json.dumps({**row, **errors(vehicles, photos, bias_m)}), flush=True)


if __name__ == "__main__":
    main()
