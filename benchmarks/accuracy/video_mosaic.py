"""Is a map from video as good as one from photos? The same pictures of a twin as JPEG, as H.264 and as H.265.

python -m benchmarks.accuracy.video_mosaic TWIN [--crf 18] [--out DIR]

TWIN is a folder that `orthoswarm twin make` wrote. Each vehicle's photos become one video with B-frames, 30 pictures a
second as a camera that took no others would write them, each with its pose as SEI. The three are mapped and measured
against the twin's truth.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from orthoswarm.model.frame import Frame

ENCODERS = {"H.264": "libx264", "H.265": "libx265"}


def encode(frames: list[Frame], target: Path, codec: str, crf: int) -> None:
    """One vehicle's pictures as a video with B-frames, poses as SEI."""
    import av

    from orthoswarm.raster.picture_file import read_rgb
    from telemetry.samples.sample import sample_of
    from telemetry.write.sei_writer import add_sei

    plain = target.with_suffix(".plain.mp4")
    options = {"crf": str(crf), "preset": "medium", "bf": "3"} | (
        {"x265-params": "log-level=error:bframes=3"} if codec == "libx265" else {}
    )
    with av.open(str(plain), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = frames[0].width, frames[0].height, "yuv420p"
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(read_rgb(frame.path), format="rgb24")
            picture.pts = number
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))

    add_sei(plain, target, lambda number: sample_of(frames[number]))
    plain.unlink()


def measure(inputs: Path, twin: Path, out: Path) -> dict[str, float]:
    """Map and evaluate."""
    orthoswarm = [sys.executable, "-m", "gcs_plugin.cli"]
    more = ["--every-m", "0.01"] if inputs != twin / "photos" else []
    subprocess.run(
        [*orthoswarm, "mosaic", str(inputs), "--basemap", str(twin / "basemap.tif"), "--out", str(out), *more],
        check=True,
    )
    truth = twin / "truth"
    result = subprocess.run(
        [*orthoswarm, "evaluate", str(out / "orthoimage.tif"), "--reference", str(truth / "reference.tif"), "--json"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    figures: dict[str, float] = json.loads(result.stdout)
    return figures


def main() -> None:
    """Print a row for each kind."""
    from telemetry.ingest.ingest import load

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twin", type=Path)
    parser.add_argument("--crf", type=int, default=18, help="quality of the videos (18 looks like the photos)")
    parser.add_argument("--out", type=Path, help="keep videos and maps here")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        out = args.out or Path(scratch)
        found = load([args.twin / "photos"])
        inputs = {"JPEG": args.twin / "photos"}
        for kind, codec in ENCODERS.items():
            inputs[kind] = out / codec
            inputs[kind].mkdir(parents=True, exist_ok=True)
            for vehicle in dict.fromkeys(frame.vehicle for frame in found.frames):
                mine = [frame for frame in found.frames if frame.vehicle == vehicle]
                encode(mine, inputs[kind] / f"{vehicle.replace('/', '_')}.mp4", codec, args.crf)
        print(f"{'':6} {'size MB':>8} {'median m':>9} {'p95 m':>7} {'unmatched':>9} {'complete':>9}")
        for kind, folder in inputs.items():
            size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
            f = measure(folder, args.twin, out / f"map-{kind}")
            row = f"{f['median_m']:9.3f} {f['p95_m']:7.3f} {f['unmatched_share']:9.4f} {f['completeness']:9.4f}"
            print(f"{kind:6} {size:8.1f} {row}", flush=True)


if __name__ == "__main__":
    main()
