"""What the paper's model could reach at best: true fields of view and the best homography for each leg.

    python -m benchmarks.accuracy.accuracy_limit SET...

SET is a folder of `orthoswarm twin make`. No picture is looked at: recorded poses, projected on their lines (Eq. 3),
are compared with the true ones, leg by leg, over the middle of each picture, which is what the map is made of.
"""

import sys
from pathlib import Path

import numpy as np

import telemetry
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.matchers.patch_registration import apply
from orthoswarm.model.camera import Camera
from orthoswarm.model.geo import LocalGrid, local_origin
from orthoswarm.mosaic.recorded_pose import area_grid
from orthoswarm.paper.coarse_cameras import find_legs, fit_line
from orthoswarm.refine.bundle.flight_records import read_records

MIDDLE = 0.35
"""Share of a picture's width and height about its middle that the map is made of."""


def leg_errors(folder: Path) -> np.ndarray:
    """Distances (N,) in metres that the best homography of each leg leaves."""
    true = read_truth(folder / "truth" / "frames.csv")
    frames = [f for f in telemetry.load([folder / "photos"]).frames if f.image in true]
    grid = area_grid(frames)
    origin = local_origin(grid, frames)
    out = []
    for vehicle in dict.fromkeys(f.vehicle for f in frames):
        own = [f for f in frames if f.vehicle == vehicle]
        out += vehicle_errors(own, [true[f.image][2] for f in own], grid, origin)
    return np.concatenate(out)


def vehicle_errors(frames, cameras, grid: LocalGrid, origin) -> list[np.ndarray]:
    records = read_records(frames, grid, origin)
    leg = find_legs(records)
    rotation = records.rotation()
    offset = np.array([*origin, 0.0])
    out = []
    for k in range(leg.max() + 1):
        members = np.flatnonzero(leg == k)
        position = records.position[members].copy()
        position[:, :2] = fit_line(position[:, :2]).project(position[:, :2])
        placed, wanted = [], []
        for i, p in zip(members.tolist(), position, strict=True):
            lens = cameras[i].lens
            u = (0.5 + MIDDLE * np.linspace(-0.5, 0.5, 4)) * lens.width
            v = (0.5 + MIDDLE * np.linspace(-0.5, 0.5, 4)) * lens.height
            pixels = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
            placed.append(Camera(p, rotation[i], lens).to_ground(pixels))
            wanted.append(cameras[i].to_ground(pixels) - offset[:2])
        a, b = np.concatenate(placed), np.concatenate(wanted)
        out.append(np.hypot(*(apply(best_homography(a, b), a - a.mean(0)) + a.mean(0) - b).T))
    return out


def best_homography(a, b):
    """Least squares homography about the middle of a, by Gauss-Newton from the shift."""
    middle = a.mean(0)
    a, b = a - middle, b - middle
    h = np.eye(3)
    h[:2, 2] = (b - a).mean(0)
    for _ in range(10):
        p = np.c_[a, np.ones(len(a))] @ h.T
        q = p[:, :2] / p[:, 2:]
        one = np.c_[a, np.ones(len(a))] / p[:, 2:]
        zero = np.zeros_like(one)
        rows = [np.c_[one, zero, -q[:, :1] * one[:, :2]], np.c_[zero, one, -q[:, 1:] * one[:, :2]]]
        jacobian = np.concatenate(rows)
        scale = np.abs(jacobian).max(0)
        step = np.linalg.lstsq(jacobian / scale, (b - q).T.ravel(), rcond=None)[0] / scale
        h = h + np.append(step, 0.0).reshape(3, 3)
    return h


def main() -> None:
    for name in sys.argv[1:]:
        error = leg_errors(Path(name))
        print(f"{Path(name).name}: median {np.median(error):.2f} m, 95 % {np.percentile(error, 95):.2f} m")


if __name__ == "__main__":
    main()
