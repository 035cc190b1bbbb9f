"""`orthoswarm twin camera`: a simulated camera that follows a real autopilot and shows it the twin's city."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import threading

    from gcs_plugin.demo.following_camera import Follower
    from gcs_plugin.fleet.fleet import Fleet

_WAIT_S: Final = 120.0
_SYSTEM: Final = 250
EXAMPLE: Final = (
    "The city is built around the place where the first vehicle stands; its map and an area to fly are written to\n"
    "DIR. With --relay one link of the autopilot serves both the camera and, at that address, the daemon.\n\n"
    "example:\n"
    "  orthoswarm twin camera --link tcp:127.0.0.1:5760 --relay tcpin:127.0.0.1:5790 \\\n"
    "      --stream tcp://127.0.0.1:5601 --set twin-sitl\n"
    "  orthoswarm serve --link tcp:127.0.0.1:5790 --source v1=tcp://127.0.0.1:5601 --basemap twin-sitl/basemap.tif"
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the action's arguments."""
    add = parser.add_argument
    add("--link", action="append", required=True, metavar="URL", help="the autopilot's link; again for more vehicles")
    add(
        "--stream",
        required=True,
        metavar="URL",
        help="tcp://HOST:PORT serves video (H.264 with the poses as SEI), udp://HOST:PORT sends it, http://HOST:PORT "
        "posts photos to a daemon; vehicle 2 uses the next port, and so on",
    )
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


def run(args: argparse.Namespace) -> int:
    """Follow until interrupted."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    import json
    import signal
    import threading

    from gcs_plugin.demo.city_site import build_world
    from gcs_plugin.demo.following_camera import FollowingCameras, Shutter, open_outlet, wait_for_place
    from gcs_plugin.demo.relay import Relay
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.links.signing import find_key
    from gcs_plugin.mission.exchange import Address
    from orthoswarm.model.errors import InputError

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
            stage, site = build_world(world)
            cameras = FollowingCameras(
                fleet, stage, site, args.stream, seed=args.seed, level=args.level, opened=_opened,
                rays=1 if args.fast else 2,
                shutter=lambda: Shutter(every_s=1.0 / args.rate, above_m=args.above, on_trigger=args.on_trigger),
            )  # fmt: skip
            print(f"map: {folder / 'basemap.tif'}; area: {folder / 'area.geojson'}", file=sys.stderr, flush=True)
            _watch(cameras, fleet, stop)
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
    from gcs_plugin.cli.progress import ProgressBars
    from gcs_plugin.demo.city_site import away_m, place_spec, read_spec, set_there, write_set
    from orthoswarm.model.errors import InputError

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


def _watch(cameras: Any, fleet: "Fleet", stop: "threading.Event") -> None:
    """Take pictures; on a terminal print their number every few seconds."""
    import threading
    import time

    def report_progress() -> None:
        while not stop.wait(5.0):
            if sys.stderr.isatty():
                parts = [f"{f.vehicle.id} {f.vehicle.mode} {f.taken} pictures" for f in cameras.followers.values()]
                print(f"\r{time.strftime('%H:%M:%S')} {', '.join(parts)}   ", end="", file=sys.stderr, flush=True)

    del fleet
    threading.Thread(target=report_progress, daemon=True).start()
    cameras.run(stop)


def _row(follower: "Follower") -> dict[str, Any]:
    return {
        "id": follower.vehicle.id, "url": follower.outlet.url, "pictures": follower.taken,
        "skipped": follower.shutter.skipped, "problem": follower.problem,
    }  # fmt: skip
