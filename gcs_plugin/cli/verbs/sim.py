"""`orthoswarm sim`: simulated vehicles that speak real MAVLink, for tests without an autopilot."""

import argparse
import sys
import threading

from orthoswarm.model.errors import InputError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "With udpout each vehicle speaks from a port of its own to a ground station there; with tcpin vehicle 1\n"
        "serves the port, vehicle 2 the next one, and so on.\n\n"
        "example:\n  orthoswarm sim --vehicles 8 --link udpout:127.0.0.1:14550\n"
        "  orthoswarm sim --vehicles 3 --autopilot mixed --loss 0.3 --reboot 2@60 --speed 5"
    )
    add = parser.add_argument
    add("--vehicles", type=int, default=3, metavar="N", help="how many (default 3)")
    add("--autopilot", choices=["ardupilot", "px4", "mixed"], default="ardupilot", help="whose dialect")
    add("--link", default="udpout:127.0.0.1:14550", metavar="URL", help="udpout:HOST:PORT or tcpin:HOST:PORT")
    add("--together", action="store_true", help="all vehicles behind one link, as behind a router")
    add("--home", default="47.397742,8.545594,488", metavar="LAT,LON[,ALT]", help="where the first one stands")
    add("--spacing", type=float, default=5.0, metavar="M", help="distance between neighbours (default 5)")
    add("--speed", type=float, default=1.0, metavar="X", help="vehicle seconds in a second (default 1)")
    add("--seconds", type=float, default=float("inf"), metavar="S", help="end after so many vehicle seconds")
    add("--ready", type=float, default=0.0, metavar="S", help="seconds until they can be armed")
    add("--gps-sigma", type=float, default=0.0, metavar="M", help="wandering error of their receivers")
    add("--seed", type=int, default=0, metavar="N", help="equal seeds give equal errors and faults")
    faults = parser.add_argument_group("faults, on each link and both ways")
    faults.add_argument("--loss", type=float, default=0.0, metavar="SHARE", help="packets that vanish, 0 to 1")
    faults.add_argument("--duplicate", type=float, default=0.0, metavar="SHARE", help="packets that come twice")
    faults.add_argument("--delay", type=float, default=0.0, metavar="S", help="greatest delay; packets overtake others")
    faults.add_argument(
        "--reboot", action="append", default=[], metavar="ID@S", help="vehicle ID restarts after S seconds"
    )
    faults.add_argument("--wipe", action="store_true", help="missions are lost at a reboot, as by ArduPilot's -w")
    faults.add_argument(
        "--silence", action="append", default=[], metavar="ID@S+D", help="vehicle ID is silent for D seconds"
    )


def run(args: argparse.Namespace) -> int:
    """Fly until interrupted, or for --seconds."""
    from gcs_plugin.links.mavlink import Autopilot
    from gcs_plugin.links.signing import find_key
    from gcs_plugin.sim.multirotor import Airframe
    from gcs_plugin.sim.simulated_swarm import Faults, SimSwarm, make_swarm

    if not (0.0 <= args.loss <= 1.0 and 0.0 <= args.duplicate <= 1.0 and args.delay >= 0.0):
        raise InputError("loss and duplicate are shares from 0 to 1, delay is seconds; correct them")
    if not 0.0 < args.speed <= 100.0:
        raise InputError(f"the speed {args.speed:g} is not possible; give a factor up to 100")
    autopilots = {
        "ardupilot": (Autopilot.ARDUPILOT,), "px4": (Autopilot.PX4,), "mixed": (Autopilot.ARDUPILOT, Autopilot.PX4),
    }[args.autopilot]  # fmt: skip
    vehicles = make_swarm(
        args.vehicles, autopilots=autopilots, home=_home(args.home), spacing_m=args.spacing,
        airframe=Airframe(gps_sigma_m=args.gps_sigma), as_flown=True, seed=args.seed, ready_s=args.ready,
        wipes=args.wipe,
    )  # fmt: skip
    events = sorted([*_events(args.reboot, "reboot"), *_events(args.silence, "silence")])
    for at, system, what, _ in events:
        if system not in {vehicle.system for vehicle in vehicles}:
            raise InputError(f"there is no vehicle {system} to {what} at {at:g} s; there are 1 to {args.vehicles}")
    faults = [
        Faults(loss=args.loss, duplicate=args.duplicate, delay_s=(0.0, args.delay), silent=(), seed=2 * args.seed + way)
        for way in (0, 1)
    ]
    swarm = SimSwarm(
        vehicles, args.link, together=args.together, speed=args.speed, up=faults[0], down=faults[1], key=find_key()
    )
    where = ", ".join(swarm.addresses) or args.link
    print(f"{args.vehicles} simulated vehicles on {where}; end with Ctrl-C", file=sys.stderr)
    with swarm:
        finished = threading.Event()
        while True:
            now = swarm.now
            while events and events[0][0] <= min(now, args.seconds):  # also of the last look: it may come late
                _, system, what, seconds = events.pop(0)
                print(f"vehicle {system}: {what}", file=sys.stderr)
                swarm.reboot(system) if what == "reboot" else swarm.silence(system, seconds)
            if now >= args.seconds or finished.wait(0.05):
                break
    return 0


def _home(text: str) -> tuple[float, float, float]:
    try:
        parts = [float(part) for part in text.split(",")]
        lat, lon, alt = (*parts, 0.0)[:3]
    except ValueError:
        raise InputError(f"'{text}' is not a place; give LAT,LON or LAT,LON,ALT in degrees and metres") from None
    if not (-85.0 <= lat <= 85.0 and -180.0 <= lon <= 180.0):
        raise InputError(f"'{text}' is not a place; give LAT,LON or LAT,LON,ALT in degrees and metres")
    return lat, lon, alt


def _events(texts: list[str], what: str) -> list[tuple[float, int, str, float]]:
    events = []
    for text in texts:
        who, _, when = text.partition("@")
        at, _, seconds = when.partition("+")
        try:
            events.append((float(at), int(who.removeprefix("v")), what, float(seconds or 10.0)))
        except ValueError:
            raise InputError(
                f"'{text}' is not a time for a vehicle; write for example 2@60, or 2@60+15 for a silence"
            ) from None
    return events
