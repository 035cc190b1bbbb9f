"""`orthoswarm twin make`: sets of photos, map and truth of a digital twin; `twin camera`: a camera that sees it."""

import argparse
import json
import math
import signal
import sys
import threading
import time
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from gcs_plugin.demo.following_camera import Follower


_FLIGHT: Final = (
    ("--columns", "columns", int, "vehicles side by side"),
    ("--rows", "rows", int, "vehicles one behind the other"),
    ("--photos", "photos", int, "photos of each vehicle"),
    ("--legs", "legs", int, "legs of each vehicle"),
    ("--spacing-m", "spacing_m", float, "distance of photos along the path"),
    ("--leg-spacing-m", "leg_spacing_m", float, "distance of legs"),
    ("--height-m", "height_m", float, "height over takeoff"),
    ("--speed-m-s", "speed_m_s", float, "cruising speed"),
    ("--width", "width", int, "columns of a photo"),
    ("--height", "height", int, "rows of a photo"),
)
"""Values of the FlightPlan: flag, field, type, help."""
_NOISE: Final = (
    ("--position-m", "position_m", float, "half range of the uniform position error"),
    ("--drift-per-photo-m", "drift_per_photo_m", float, "half range of the drift per photo"),
    ("--heading-bias-deg", "heading_bias_deg", float, "one sigma of the compass error of a vehicle"),
    ("--tilt-bias-deg", "tilt_bias_deg", float, "one sigma of the pitch and roll error of a vehicle"),
    ("--angle-deg", "angle_deg", float, "one sigma of the angles from photo to photo"),
    ("--outlier-share", "outlier_share", float, "share of positions that are 5 to 20 m off"),
    ("--height-noise-m", "height_m", float, "one sigma of the height from photo to photo"),
    ("--height-offset-m", "height_offset_m", float, "fixed error of all heights"),
)
"""Values of the Noise."""
_MOTION: Final = (
    ("--wobble-deg", "attitude_deg", float, "one sigma of the airframe's roll and pitch"),
    ("--true-drift-m", "drift_m", float, "receiver drift that the autopilot follows"),
    ("--mount-yaw-deg", "mount_yaw_deg", float, "range of the camera's yaw offset"),
    ("--mount-pitch-deg", "mount_pitch_deg", float, "range of the camera's pitch offset"),
)
"""Values of the FlightDeviations."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = "example:\n  orthoswarm twin make tiny --out twin-tiny --seed 1 --noise paper"
    actions = parser.add_subparsers(dest="action", required=True, metavar="make|camera")
    example = "example:\n  orthoswarm twin make debris --out debris-hard --seed 3 --noise hard --lens=-0.05,0.01"
    make = actions.add_parser("make", help="make a set of photos, basemap and truth", epilog=example)
    camera_help = "follow a real autopilot with a camera that sees the city"
    _configure_camera(actions.add_parser("camera", help=camera_help, epilog=_CAMERA_EXAMPLE))
    add = make.add_argument
    add("preset", metavar="PRESET", help="tiny (40 photos), debris, water, haze, clear (1,017 each), full (32,544)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the set; an interrupted run goes on there")
    add("--seed", type=int, default=1, help="which city, flight and noise (default 1)")
    add("--noise", default="paper", metavar="KIND", help="none, paper, hard, drift, wind or curves (default paper)")
    add("--disaster", choices=("none", "debris", "water", "haze", "collapse", "all"), help="instead of the preset's")
    add("--lens", metavar="K1,K2", help="radial distortion of all lenses, in units of f (write --lens=-0.05,0.01)")
    add("--relief", type=float, default=0.0, metavar="M", help="smooth ground relief of +-M metres")
    add("--follow-ground", action="store_true", help="legs keep --height-m above the bare ground instead of one level")
    add("--ground", type=Path, metavar="ORTHO.tif", help="a real orthoimage as the ground; needs --surface")
    add("--surface", type=Path, metavar="DSM.tif", help="its surface model (uint16: height = 100 + v/100 m; or float)")
    add("--dtm", type=Path, metavar="DTM.tif", help="its bare ground, in the same form")
    add("--every", type=int, default=1, metavar="N", help="render every N-th photo only")
    add("--workers", type=int, default=1, metavar="N", help="threads that render (default 1)")
    lean_help = "lean of the map, metres per metre of height (default drawn, 0.2 to 0.35)"
    add("--lean", type=float, metavar="S", help=lean_help)
    add("--lean-deg", type=float, metavar="DEG", help="azimuth of the lean (default drawn)")
    add("--heading-deg", type=float, metavar="DEG", help="azimuth of the legs (default drawn)")
    add("--lat", type=float, metavar="DEG", help="where the city lies")
    add("--lon", type=float, metavar="DEG", help="where the city lies")
    add("--map-gsd", type=float, metavar="M", help="pixel of the basemap (default 0.4)")
    add("--rays", type=int, metavar="N", help="rays along the side of a pixel (default 2; 1 for full: faster)")
    add("--quality", type=int, metavar="Q", help="JPEG quality (default 92)")
    _add_values(make, "flight", _FLIGHT)
    noise = _add_values(make, "errors of the record (each replaces the value of --noise)", _NOISE)
    noise.add_argument("--lag-s", metavar="LOW,HIGH", help="range of the time lag of positions, seconds")
    _add_values(make, "true motion", _MOTION)
    add("--json", action="store_true", help="one JSON document on stdout")


_Values = tuple[tuple[str, str, type, str], ...]


def _add_values(parser: argparse.ArgumentParser, title: str, values: _Values) -> Any:
    """A group of the help with the flags of a dataclass's values."""
    group = parser.add_argument_group(title)
    for flag, _, kind, text in values:
        group.add_argument(flag, type=kind, metavar="X", help=text)
    return group


def _given(args: argparse.Namespace, values: _Values) -> dict[str, Any]:
    """What was given of them, by field."""
    given = {field: getattr(args, flag[2:].replace("-", "_")) for flag, field, _, _ in values}
    return _known(given)


def run(args: argparse.Namespace) -> int:
    """Make the set, or follow a vehicle."""
    if args.action == "camera":
        return _follow_vehicles(args)
    from gcs_plugin.cli.arguments import ProgressBars
    from orthoswarm.twin.make import make_twin

    _check(args)
    spec = _spec(args)
    with ProgressBars() as progress:
        result = make_twin(spec, args.out, workers=max(1, args.workers), progress=progress)
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
    """Refuse values of which no set can be made; raises InputError: one is out of range, or --out is a file."""
    from gcs_plugin.cli.arguments import require_no_file

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
    if text is None:
        return None
    try:
        first, second = (float(x) for x in text.split(","))
    except ValueError:
        raise InputError(f"{flag} takes two numbers with a comma between them, not '{text}'") from None
    return first, second


def _spec(args: argparse.Namespace) -> Any:

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
    plan = replace(base.plan, **_given(args, _FLIGHT))
    if plan.leg_length_m <= 0:
        raise InputError("the photos do not suffice for so many legs; give more --photos or fewer --legs")
    lag = _known({"lag_s": _pair(args.lag_s, "--lag-s")})
    noise = replace(base.noise, **_given(args, _NOISE), **lag)
    motion = replace(base.motion, **_given(args, _MOTION))
    complete = with_heading(replace(base, plan=plan, noise=noise, motion=motion))
    if args.heading_deg is not None:
        complete = replace(complete, plan=replace(complete.plan, heading_rad=math.radians(args.heading_deg)))
    return complete


def _known(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


# -- twin camera -------------------------------------------------------------------------------------------------------

_WAIT_S: Final = 120.0
_SYSTEM: Final = 250
_CAMERA_EXAMPLE: Final = (
    "The city is built around the place where the first vehicle stands; its map and an area to fly are written to\n"
    "DIR. With --relay one link of the autopilot serves both the camera and, at that address, the daemon.\n\n"
    "example:\n"
    "  orthoswarm twin camera --link tcp:127.0.0.1:5760 --relay tcpin:127.0.0.1:5790 \\\n"
    "      --stream tcp://127.0.0.1:5601 --set twin-sitl\n"
    "  orthoswarm serve --link tcp:127.0.0.1:5790 --source v1=tcp://127.0.0.1:5601 --basemap twin-sitl/basemap.tif"
)


def _configure_camera(parser: argparse.ArgumentParser) -> None:
    """Add the action's arguments."""
    add = parser.add_argument
    add("--link", action="append", required=True, metavar="URL", help="the autopilot's link; again for more vehicles")
    add(
        "--stream", required=True, metavar="URL",
        help="tcp://HOST:PORT serves video (H.264 with the poses as SEI), udp://HOST:PORT sends it, http://HOST:PORT "
        "posts photos to a daemon; vehicle 2 uses the next port, and so on",
    )  # fmt: skip
    add("--relay", metavar="URL", help="where a ground station finds the vehicles behind the camera, e.g. tcpin:...")
    add("--set", type=Path, metavar="DIR", help="set of `twin make`, or where a new one goes (default twin-PRESET)")
    add("--preset", default="tiny", help="city of a new set (default tiny, 0.67 x 0.43 km; debris has 1.8 x 1.2 km)")
    add("--seed", type=int, default=1, help="which city, and which errors the cameras have (default 1)")
    add("--lat", type=float, metavar="DEG", help="middle of a new city (default: where the first vehicle stands)")
    add("--lon", type=float, metavar="DEG", help="middle of a new city")
    add("--vehicles", type=int, default=1, metavar="N", help="wait for so many before the city is built (default 1)")
    add("--rate", type=float, default=2.0, metavar="HZ", help="pictures a second of the vehicle's clock (default 2)")
    add("--above", type=float, default=20.0, metavar="M", help="least height over takeoff for pictures (default 20)")
    add("--on-trigger", action="store_true", help="take pictures only when the autopilot reports an exposure")
    add("--level", action="store_true", help="hold the camera level, like a gimbal that the autopilot does not know of")
    add("--fast", action="store_true", help="one ray a pixel: four times faster, edges less smooth")
    add("--json", action="store_true", help="at the end one JSON document on stdout")


def _follow_vehicles(args: argparse.Namespace) -> int:
    """Follow until interrupted."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()

    from gcs_plugin.demo.following_camera import FollowingCameras, Relay, Shutter, open_outlet, wait_for_place
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.links.signing import find_key
    from gcs_plugin.mission.exchange import Address
    from orthoswarm.twin.dataset_files import damaged_city

    if not 0.05 <= args.rate <= 30.0:
        raise InputError(f"--rate {args.rate:g} is not possible; choose 0.05 to 30 pictures a second")
    if (args.lat is None) != (args.lon is None):
        raise InputError("give --lat and --lon together")
    open_outlet(args.stream, 1).close()  # a wrong address is reported before anything is built
    own = Address(_SYSTEM, 191)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with Fleet(args.link, own=own, key=find_key()) as fleet:
        relay = Relay(fleet, args.relay, own) if args.relay else None
        if relay is not None:
            relay.start()  # first of all, as it receives every packet of the fleet
        try:
            place = wait_for_place(fleet, args.vehicles, _WAIT_S, stop, _say)
            if place is None:
                return 1
            poller = threading.Thread(target=fleet.run, args=(stop,), name="links", daemon=True)
            poller.start()
            folder, world = _world(args, place)
            stage, site = damaged_city(world)
            cameras = FollowingCameras(
                fleet, stage, site, args.stream, seed=args.seed, level=args.level, opened=_opened,
                rays=1 if args.fast else 2,
                shutter=lambda: Shutter(every_s=1.0 / args.rate, above_m=args.above, on_trigger=args.on_trigger),
            )  # fmt: skip
            print(f"map: {folder / 'basemap.tif'}; area: {folder / 'area.geojson'}", file=sys.stderr, flush=True)
            _watch(cameras, stop)
            poller.join(5.0)
            cameras.close()
        finally:
            stop.set()
            if relay is not None:
                relay.close()
    rows = [_row(follower) for _, follower in sorted(cameras.followers.items())]
    if args.json:
        print(json.dumps({"set": str(folder), "vehicles": rows}))
    else:
        for row in rows:
            print(f"{row['id']}: {row['pictures']} pictures, {row['skipped']} skipped {row['problem']}".rstrip())
    return 0 if any(row["pictures"] for row in rows) else 1


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _world(args: argparse.Namespace, place: tuple[float, float]) -> tuple[Path, Any]:
    """The set's folder and its specification; made if absent."""
    from gcs_plugin.cli.arguments import ProgressBars
    from gcs_plugin.demo.following_camera import away_m, place_spec, read_spec, set_there, write_set

    folder = args.set or Path(f"twin-{args.preset}")
    if set_there(folder):
        world = read_spec(folder)
    else:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} holds something else; choose an empty folder for --set")
        lat, lon = place if args.lat is None else (args.lat, args.lon)
        world = place_spec(args.preset, args.seed, lat, lon)
    far = away_m(world, *place)
    if far > 0.0:
        raise InputError(
            f"the vehicle stands {far / 1000.0:.1f} km beside the city of {folder}; start the simulator with its home "
            f"at {world.lat_deg:.6f},{world.lon_deg:.6f}, or choose an empty folder for --set"
        )
    with ProgressBars() as progress:
        write_set(world, folder, progress)
    return folder, world


def _opened(follower: "Follower") -> None:
    vehicle = follower.vehicle
    what = "posts photos to" if follower.outlet.url.startswith("http") else f"--source {vehicle.id}="
    print(
        f"camera of {vehicle.id} ({vehicle.autopilot.value}): {what}{follower.outlet.url}", file=sys.stderr, flush=True
    )


def _watch(cameras: Any, stop: "threading.Event") -> None:
    """Take pictures; on a terminal print their number every few seconds."""

    def report_progress() -> None:
        while not stop.wait(5.0):
            if sys.stderr.isatty():
                parts = [f"{f.vehicle.id} {f.vehicle.mode} {f.taken} pictures" for f in cameras.followers.values()]
                print(f"\r{time.strftime('%H:%M:%S')} {', '.join(parts)}   ", end="", file=sys.stderr, flush=True)

    threading.Thread(target=report_progress, daemon=True).start()
    cameras.run(stop)


def _row(follower: "Follower") -> dict[str, Any]:
    return {
        "id": follower.vehicle.id, "url": follower.outlet.url, "pictures": follower.taken,
        "skipped": follower.shutter.skipped, "problem": follower.problem,
    }  # fmt: skip
