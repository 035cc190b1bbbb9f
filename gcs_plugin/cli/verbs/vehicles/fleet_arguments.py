"""The arguments of `orthoswarm fleet`: its verbs, their options and examples."""

import argparse
from pathlib import Path
from typing import Final

from gcs_plugin.config import LIMITS

DEFAULT_LINK: Final = "udpin:0.0.0.0:14550"

_WAIT_S = 8.0
_VERBS = {
    "list": "show the vehicles",
    "upload": "put missions into vehicles and read them back",
    "start": "let vehicles fly their missions from the beginning (mode, arm, start)",
    "pause": "hold vehicles where they are",
    "resume": "let paused vehicles go on with what they did: their missions, or their ways home",
    "continue": "let vehicles in the air go on with missions that they broke off; checks battery, fence and failsafes",
    "rtl": "let vehicles fly home and land",
    "land": "let vehicles land where they are",
    "check": "check vehicles before their start",
    "watch": "follow missions until each has ended",
}
_EXAMPLES = {
    "list": "orthoswarm fleet list --link udpin:0.0.0.0:14550",
    "upload": (
        "orthoswarm fleet upload missions --link udpin:0.0.0.0:14550     (a folder made by `orthoswarm plan`)\n"
        "  orthoswarm fleet upload survey.plan --vehicle 3 --link tcp:127.0.0.1:5760"
    ),
    "start": (
        "orthoswarm fleet start --plan missions --watch --link udpin:0.0.0.0:14550     (at the plan's times)\n"
        "  orthoswarm fleet start --vehicle 3 --link tcp:127.0.0.1:5760"
    ),
    "pause": "orthoswarm fleet pause --vehicle 3 --link udpin:0.0.0.0:14550",
    "resume": "orthoswarm fleet resume --vehicle 3 --link udpin:0.0.0.0:14550",
    "continue": "orthoswarm fleet continue --vehicle 3 --link udpin:0.0.0.0:14550",
    "rtl": (
        "orthoswarm fleet rtl --link udpin:0.0.0.0:14550     (all at once)\n"
        "  orthoswarm fleet rtl --in-turn --link udpin:0.0.0.0:14550     (so that they do not meet on their ways)"
    ),
    "land": "orthoswarm fleet land --vehicle 3 --link udpin:0.0.0.0:14550",
    "check": "orthoswarm fleet check --plan missions --link udpin:0.0.0.0:14550",
    "watch": "orthoswarm fleet watch --link udpin:0.0.0.0:14550 --seconds 1800",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add them to the parser of the verb."""
    parser.epilog = (
        "A link is udpin:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, or serial:DEVICE:BAUD; give --link\n"
        f"again for more; without one, {DEFAULT_LINK}. Nothing moves a vehicle but start, resume, continue,\n"
        "rtl and land.\n\n"
        f"example:\n  {_EXAMPLES['list']}"
    )
    verbs = parser.add_subparsers(dest="action", required=True, metavar="VERB")
    for name, text in _VERBS.items():
        verb = verbs.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=f"example:\n  {_EXAMPLES[name]}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        _common(verb)
        if name == "upload":
            verb.add_argument(
                "missions",
                nargs="+",
                type=Path,
                metavar="MISSION",
                help="folder of a plan, or .plan or .waypoints files",
            )
            verb.add_argument("--sortie", type=int, default=1, metavar="N", help="which flight of a plan (default 1)")
        if name in ("start", "check"):
            _start_arguments(verb)
        if name == "start":
            verb.add_argument("--watch", action="store_true", help="follow the missions until each has ended")
            verb.add_argument(
                "--ready", type=float, default=60.0, metavar="S",
                help="wait at most this long until all vehicles' own checks pass (default 60)",
            )  # fmt: skip
        if name in ("start", "continue"):
            verb.add_argument(
                "--override", action="append", default=[], metavar="ITEM",
                help="do it in spite of a red item of the check: battery, or v3:battery for one vehicle",
            )  # fmt: skip
        if name == "continue":
            verb.set_defaults(ready=0.0, max_height=LIMITS.legal_height_m, plan=None)
        if name == "rtl":
            verb.add_argument(
                "--in-turn", action="store_true",
                help="those whose ways home come near each other hold and return one after the other",
            )  # fmt: skip
            verb.add_argument(
                "--seconds", type=float, default=7200.0, metavar="S",
                help="with --in-turn: wait for turns at most this long; who waits then holds (default 7200)",
            )  # fmt: skip
        if name in ("start", "watch"):
            verb.add_argument(
                "--seconds", type=float, default=7200.0, metavar="S", help="follow at most this long (default 7200)"
            )


def _start_arguments(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("--plan", type=Path, metavar="DIR", help="folder of a plan: its vehicles, at its times")
    verb.add_argument("--sortie", type=int, default=1, metavar="N", help="which flight of the plan (default 1)")
    verb.add_argument(
        "--max-height", type=float, default=LIMITS.legal_height_m, metavar="M",
        help=f"height above takeoff that may be flown (default {LIMITS.legal_height_m:g}, the usual legal limit)",
    )  # fmt: skip


def _common(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--link",
        action="append",
        default=[],
        metavar="URL",
        help=f"link to vehicles, several allowed ({DEFAULT_LINK})",
    )
    add("--vehicle", action="append", default=[], metavar="ID", help="system ids: 3, v3, or 1,2,5 (default: all heard)")
    add("--wait", type=float, default=_WAIT_S, metavar="S", help=f"wait for vehicles at most this long ({_WAIT_S:g})")
    add("--json", action="store_true", help="one JSON document on stdout")
    add(
        "--backend",
        default="pymavlink",
        choices=["pymavlink", "mavsdk"],
        help="library for MAVLink (pymavlink)",
    )
    add("--tlog", type=Path, metavar="FILE", help="append all packets to a telemetry log")
    add(
        "--signing-key",
        type=Path,
        metavar="FILE",
        help="key for signed MAVLink (or ORTHOSWARM_SIGNING_KEY_FILE, ORTHOSWARM_SIGNING_KEY)",
    )
    add("--gcs-system", type=int, default=255, metavar="ID", help="our own system id (255)")
