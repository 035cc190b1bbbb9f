"""`orthoswarm twin make`: sets of photos, map and truth of a digital twin; `twin camera`: a camera that sees it."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from gcs_plugin.cli.verbs.tools import twin_camera

    parser.epilog = "example:\n  orthoswarm twin make tiny --out twin-tiny --seed 1 --noise paper"
    actions = parser.add_subparsers(dest="action", required=True, metavar="make|camera")
    make = actions.add_parser(
        "make",
        help="make a set of photos, basemap and truth",
        epilog="example:\n  orthoswarm twin make debris --out debris-hard --seed 3 --noise hard --lens=-0.05,0.01",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    camera = actions.add_parser(
        "camera",
        help="follow a real autopilot with a camera that sees the city",
        epilog=twin_camera.EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    twin_camera.configure(camera)
    add = make.add_argument
    add("preset", metavar="PRESET", help="tiny (40 photos), debris, water, haze, clear (1,017 each), full (32,544)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the set; an interrupted run goes on there")
    add("--seed", type=int, default=1, help="which city, flight and noise (default 1)")
    add("--noise", default="paper", metavar="KIND", help="none, paper, hard, drift, wind or curves (default paper)")
    add("--disaster", choices=("none", "debris", "water", "haze", "all"), help="instead of the preset's")
    add("--lens", metavar="K1,K2", help="radial distortion of all lenses, in units of f (write --lens=-0.05,0.01)")
    add("--relief", type=float, default=0.0, metavar="M", help="smooth ground relief of +-M metres")
    add("--follow-ground", action="store_true", help="legs keep --height-m above the bare ground instead of one level")
    add("--ground", type=Path, metavar="ORTHO.tif", help="a real orthoimage as the ground; needs --surface")
    add("--surface", type=Path, metavar="DSM.tif", help="its surface model (uint16: height = 100 + v/100 m; or float)")
    add("--dtm", type=Path, metavar="DTM.tif", help="its bare ground, in the same form")
    add("--every", type=int, default=1, metavar="N", help="render every N-th photo only")
    add("--workers", type=int, default=1, metavar="N", help="threads that render (default 1)")
    add(
        "--lean",
        type=float,
        metavar="S",
        help="lean of the map, metres per metre of height (default drawn, 0.2 to 0.35)",
    )
    add("--lean-deg", type=float, metavar="DEG", help="azimuth of the lean (default drawn)")
    add("--heading-deg", type=float, metavar="DEG", help="azimuth of the legs (default drawn)")
    add("--lat", type=float, metavar="DEG", help="where the city lies")
    add("--lon", type=float, metavar="DEG", help="where the city lies")
    add("--map-gsd", type=float, metavar="M", help="pixel of the basemap (default 0.4)")
    add("--rays", type=int, metavar="N", help="rays along the side of a pixel (default 2; 1 for full: faster)")
    add("--quality", type=int, metavar="Q", help="JPEG quality (default 92)")
    plan = make.add_argument_group("flight")
    for flag, kind, text in (
        ("--columns", int, "vehicles side by side"),
        ("--rows", int, "vehicles one behind the other"),
        ("--photos", int, "photos of each vehicle"),
        ("--legs", int, "legs of each vehicle"),
        ("--spacing-m", float, "distance of photos along the path"),
        ("--leg-spacing-m", float, "distance of legs"),
        ("--height-m", float, "height over takeoff"),
        ("--speed-m-s", float, "cruising speed"),
        ("--width", int, "columns of a photo"),
        ("--height", int, "rows of a photo"),
    ):
        plan.add_argument(flag, type=kind, metavar="X", help=text)
    noise = make.add_argument_group("errors of the record (each replaces the value of --noise)")
    for flag, text in (
        ("--position-m", "half range of the uniform position error"),
        ("--drift-per-photo-m", "half range of the drift per photo"),
        ("--heading-bias-deg", "one sigma of the compass error of a vehicle"),
        ("--tilt-bias-deg", "one sigma of the pitch and roll error of a vehicle"),
        ("--angle-deg", "one sigma of the angles from photo to photo"),
        ("--outlier-share", "share of positions that are 5 to 20 m off"),
        ("--height-noise-m", "one sigma of the height from photo to photo"),
        ("--height-offset-m", "fixed error of all heights"),
    ):
        noise.add_argument(flag, type=float, metavar="X", help=text)
    noise.add_argument("--lag-s", metavar="LOW,HIGH", help="range of the time lag of positions, seconds")
    motion = make.add_argument_group("true motion")
    for flag, text in (
        ("--wobble-deg", "one sigma of the airframe's roll and pitch"),
        ("--true-drift-m", "receiver drift that the autopilot follows"),
        ("--mount-yaw-deg", "range of the camera's yaw offset"),
        ("--mount-pitch-deg", "range of the camera's pitch offset"),
    ):
        motion.add_argument(flag, type=float, metavar="X", help=text)
    add("--json", action="store_true", help="one JSON document on stdout")


def run(args: argparse.Namespace) -> int:
    """Make the set, or follow a vehicle."""
    if args.action == "camera":
        from gcs_plugin.cli.verbs.tools import twin_camera

        return twin_camera.run(args)
    import json
    import sys

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from orthoswarm.twin.make import make_twin

    _check(args)
    spec = _spec(args)
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=Console(stderr=True), transient=not sys.stderr.isatty(),
    )  # fmt: skip
    with bar:
        task = bar.add_task("twin", total=1)
        result = make_twin(
            spec,
            args.out,
            workers=max(1, args.workers),
            progress=lambda name, done, total: bar.update(task, description=name, completed=done, total=total),
        )
    summary = {"folder": str(result.folder), "photos": result.photos, "made": result.made, "vehicles": result.vehicles}
    if args.json:
        print(json.dumps(summary))
    else:
        print(f"{result.photos} photos of {result.vehicles} vehicles in {result.folder} ({result.made} made now)")
    return 0


_LEAST = {
    "every": 1, "rays": 1, "quality": 1, "columns": 1, "rows": 1, "photos": 2, "legs": 1, "width": 16, "height": 16,
}  # fmt: skip
_POSITIVE = ("map_gsd", "spacing_m", "leg_spacing_m", "height_m", "speed_m_s")


def _check(args: argparse.Namespace) -> None:
    """Refuse values of which no set can be made.

    Raises:
        InputError: one is out of range, or --out is a file.
    """
    from math import inf

    from gcs_plugin.cli.written_files import require_no_file
    from orthoswarm.model.errors import InputError

    for name, least in _LEAST.items():
        value = getattr(args, name)
        if value is not None and value < least:
            raise InputError(f"--{name} {value} is too few; give {least} or more")
    if args.quality is not None and args.quality > 100:
        raise InputError(f"--quality {args.quality} is out of range; give 1 to 100")
    for name in _POSITIVE:
        value = getattr(args, name)
        if value is not None and not 0.0 < value < inf:
            raise InputError(f"--{name.replace('_', '-')} {value:g} must be greater than zero")
    lag = _pair(args.lag_s, "--lag-s")
    if lag is not None and not -inf < lag[0] <= lag[1] < inf:
        raise InputError(f"--lag-s {args.lag_s} is no range; give the lower number first")
    require_no_file("--out", args.out)


def _pair(text: str | None, flag: str) -> tuple[float, float] | None:
    from orthoswarm.model.errors import InputError

    if text is None:
        return None
    try:
        first, second = (float(x) for x in text.split(","))
    except ValueError:
        raise InputError(f"{flag} takes two numbers with a comma between them, not '{text}'") from None
    return first, second


def _spec(args: argparse.Namespace) -> Any:
    import math

    from orthoswarm.model.errors import InputError
    from orthoswarm.twin.presets import spec
    from orthoswarm.twin.site import with_heading

    values = {
        "disaster": args.disaster, "lens_k": _pair(args.lens, "--lens"), "relief_m": args.relief, "every": args.every,
        "lean": args.lean, "lean_deg": args.lean_deg, "lat_deg": args.lat, "lon_deg": args.lon,
        "map_gsd_m": args.map_gsd, "quality": args.quality, "rays": args.rays, "follow_ground": args.follow_ground,
    }  # fmt: skip
    if args.ground is not None:
        if args.surface is None:
            raise InputError("--ground needs --surface DSM.tif, too")
        values["ground"] = (str(args.ground), str(args.surface), str(args.dtm or ""))
    base = spec(args.preset, seed=args.seed, noise=args.noise, **_known(values))
    plan = replace(base.plan, **_known({
        "columns": args.columns, "rows": args.rows, "photos": args.photos, "legs": args.legs,
        "spacing_m": args.spacing_m, "leg_spacing_m": args.leg_spacing_m, "height_m": args.height_m,
        "speed_m_s": args.speed_m_s, "width": args.width, "height": args.height,
    }))  # fmt: skip
    if plan.leg_length_m <= 0:
        raise InputError("the photos do not suffice for so many legs; give more --photos or fewer --legs")
    noise = replace(base.noise, **_known({
        "position_m": args.position_m, "drift_per_photo_m": args.drift_per_photo_m,
        "heading_bias_deg": args.heading_bias_deg, "tilt_bias_deg": args.tilt_bias_deg, "angle_deg": args.angle_deg,
        "outlier_share": args.outlier_share, "height_m": args.height_noise_m, "height_offset_m": args.height_offset_m,
        "lag_s": _pair(args.lag_s, "--lag-s"),
    }))  # fmt: skip
    motion = replace(base.motion, **_known({
        "attitude_deg": args.wobble_deg, "drift_m": args.true_drift_m,
        "mount_yaw_deg": args.mount_yaw_deg, "mount_pitch_deg": args.mount_pitch_deg,
    }))  # fmt: skip
    complete = with_heading(replace(base, plan=plan, noise=noise, motion=motion))
    if args.heading_deg is not None:
        complete = replace(complete, plan=replace(complete.plan, heading_rad=math.radians(args.heading_deg)))
    return complete


def _known(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
