"""Run in the environment of pycolmap: camera poses of all photos of a folder, in COLMAP's own frame and scale.

Usage: colmap.py PHOTOS OUT THREADS. Sub-folders are one camera each. Writes OUT/poses.json: a list of models, each
with `cameras` (image -> center, rotation camera to world, width, height, focal_px, k1) and `points` (some of its 3-D
points).

At most 1,024 features a picture are used, and pairs only between neighbours in time (10) and in recorded position
(the 20 nearest): with the defaults two cores would need days.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap  # type: ignore[import-not-found,unused-ignore]

FEATURES, IN_TIME, IN_SPACE, REACH_M = 1024, 10, 20, 150.0


def main() -> int:
    """Extract features, match pairs, map incrementally; the exit code is 1 without a model."""
    photos, out, threads = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    database = out / "database.db"
    pycolmap.set_random_seed(0)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads)
    extraction.sift.max_num_features = FEATURES
    extraction.sift.first_octave = 0
    cpu = pycolmap.Device.cpu
    one_each = pycolmap.CameraMode.PER_FOLDER
    pycolmap.extract_features(database, photos, camera_mode=one_each, extraction_options=extraction, device=cpu)
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads)
    time = pycolmap.SequentialPairingOptions(overlap=IN_TIME, quadratic_overlap=False, num_threads=threads)
    pycolmap.match_sequential(database, matching_options=matching, pairing_options=time, device=cpu)
    space = pycolmap.SpatialPairingOptions(max_num_neighbors=IN_SPACE, max_distance=REACH_M, num_threads=threads)
    pycolmap.match_spatial(database, matching_options=matching, pairing_options=space, device=cpu)
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=0, extract_colors=False)
    models = pycolmap.incremental_mapping(database, photos, out, options)
    if not models:
        print("it found no model", file=sys.stderr)
        return 1
    (out / "poses.json").write_text(json.dumps([as_text(model) for model in models.values()]))
    return 0


def as_text(model: Any) -> dict[str, Any]:
    """A model as JSON values."""
    cameras = {}
    for image in model.images.values():
        if not image.has_pose:
            continue
        pose, camera = image.cam_from_world(), model.cameras[image.camera_id]
        rotation = np.asarray(pose.rotation.matrix()).T
        cameras[image.name] = {
            "center": (-rotation @ np.asarray(pose.translation)).tolist(),
            "rotation": rotation.tolist(),
            "width": camera.width,
            "height": camera.height,
            "focal_px": camera.params[0],
            "k1": camera.params[3],
        }
    points = np.array([point.xyz for point in model.points3D.values() if point.track.length() >= 4]).reshape(-1, 3)
    return {"cameras": cameras, "points": points[:: max(1, len(points) // 5000)].tolist()}


if __name__ == "__main__":
    sys.exit(main())
