"""Run in the environment of OpenCV 4: `Stitcher` in SCANS mode on all photos of a folder.

Usage: stitch.py PHOTOS OUT THREADS. Writes OUT/picture.png and OUT/outcome.json with the number of pictures it joined.
"""

import json
import sys
from pathlib import Path

import cv2


def main() -> int:
    """Stitch; the exit code is 1 if the stitcher reports a failure, with its reason on stderr."""
    photos, out, threads = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    cv2.setNumThreads(threads)
    cv2.ocl.setUseOpenCL(False)
    pictures = [cv2.imread(str(path)) for path in sorted(photos.rglob("*.JPG"))]
    stitcher = cv2.Stitcher.create(cv2.Stitcher_SCANS)
    status, picture = stitcher.stitch(pictures)
    if status != cv2.Stitcher_OK:
        reasons = {
            cv2.Stitcher_ERR_NEED_MORE_IMGS: "it found no pictures that fit together",
            cv2.Stitcher_ERR_HOMOGRAPHY_EST_FAIL: "it could not estimate the transformations",
            cv2.Stitcher_ERR_CAMERA_PARAMS_ADJUST_FAIL: "its adjustment failed",
        }
        print(reasons.get(status, f"status {status}"), file=sys.stderr)
        return 1
    cv2.imwrite(str(out / "picture.png"), picture)
    (out / "outcome.json").write_text(json.dumps({"used": len(stitcher.component())}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
