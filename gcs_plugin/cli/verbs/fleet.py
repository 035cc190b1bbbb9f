"""`orthoswarm fleet`: the vehicles on the links: list, upload, check, start, pause, resume, continue, RTL, land."""

import argparse
import json
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.config import LIMITS
from gcs_plugin.mission.plan_folder import NO_NEEDS, number_in, plan_needs, read_plan_folder
from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from gcs_plugin.backends import Backend
    from gcs_plugin.fleet.commands import Order
    from gcs_plugin.fleet.preflight import Check
    from gcs_plugin.fleet.reception import FleetEvent
    from gcs_plugin.mission.exchange import Outcome
    from gcs_plugin.mission.items import Mission

DEFAULT_LINK: Final = "udpin:0.0.0.0:14550"
_WAIT_S: Final = 8.0
_STEP_S: Final = 0.05
_PASSING: Final = frozenset({"link", "gps", "ekf", "home", "pre-arm"})  # red items that clear by waiting
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


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "A link is udpin:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, or serial:DEVICE:BAUD; give --link\n"
        f"again for more; without one, {DEFAULT_LINK}. Nothing moves a vehicle but start, resume, continue,\n"
        "rtl and land.\n\n"
        f"example:\n  {_EXAMPLES['list']}"
    )
    verbs = parser.add_subparsers(dest="action", required=True, metavar="VERB")
    for name, text in _VERBS.items():
        about, example = text[0].upper() + text[1:] + ".", f"example:\n  {_EXAMPLES[name]}"
        verb = verbs.add_parser(name, help=text, description=about, epilog=example)
        _common(verb)
        if name == "upload":
            missions_help = "folder of a plan, or mission files (.plan, .waypoints, of Pilot 2 or Litchi)"
            verb.add_argument("missions", nargs="+", type=Path, metavar="MISSION", help=missions_help)
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
        "--link", action="append", default=[], metavar="URL", help=f"link to vehicles, several allowed ({DEFAULT_LINK})"
    )
    add("--vehicle", action="append", default=[], metavar="ID", help="system ids: 3, v3, or 1,2,5 (default: all heard)")
    add("--wait", type=float, default=_WAIT_S, metavar="S", help=f"wait for vehicles at most this long ({_WAIT_S:g})")
    add("--json", action="store_true", help="one JSON document on stdout")
    add("--backend", default="pymavlink", choices=["pymavlink", "mavsdk"], help="library for MAVLink (pymavlink)")
    add("--tlog", type=Path, metavar="FILE", help="append all packets to a telemetry log")
    key_help = "key for signed MAVLink (or ORTHOSWARM_SIGNING_KEY_FILE, ORTHOSWARM_SIGNING_KEY)"
    add("--signing-key", type=Path, metavar="FILE", help=key_help)
    add("--gcs-system", type=int, default=255, metavar="ID", help="our own system id (255)")


def run(args: argparse.Namespace) -> int:
    """Open the links, run the action, close them."""
    from gcs_plugin.backends import open_backend
    from gcs_plugin.fleet.commands import URGENT
    from gcs_plugin.links.signing import find_key
    from gcs_plugin.mission.exchange import Address

    if not 1 <= args.gcs_system <= 255:
        raise InputError(f"our system id cannot be {args.gcs_system}; give 1 to 255")
    for name, value in (
        ("--wait", args.wait),
        ("--seconds", getattr(args, "seconds", 0.0)),
        ("--ready", getattr(args, "ready", 0.0)),
    ):
        if not value >= 0.0:
            raise InputError(f"{name} {value:g} is not a time; give seconds, 0 or more")
    systems = parse_systems(args.vehicle)
    prepared = _Prepared(args, systems)
    backend = open_backend(
        args.backend,
        args.link or [DEFAULT_LINK],
        own=Address(args.gcs_system, 190),
        key=find_key(args.signing_key),
        tlog=args.tlog,
    )
    try:
        if args.action in URGENT and not systems and not getattr(args, "in_turn", False):
            return _as_they_are_heard(backend, args)
        found = backend.discover(args.wait, prepared.systems)
        if not found or (prepared.systems and not set(prepared.systems) & set(found)):
            return _nobody(backend, args, prepared.systems, found)
        if args.action == "rtl" and args.in_turn:
            return _return_in_turn(backend, args, prepared, found)
        actions = {"list": _list, "upload": _upload, "watch": _watch, "check": _check}
        return actions.get(args.action, _command)(backend, args, prepared, found)
    finally:
        backend.close()


class _Prepared:
    """The files and vehicles of the arguments, read before any link is opened.

    Attributes:
        systems: requested vehicles, empty for all.
        files: mission file for each vehicle of an upload or of a started plan; `single`: a file for the only
            vehicle heard.
        delays: seconds after the first takeoff for each vehicle of a plan. needs: of the plan.
    """

    def __init__(self, args: argparse.Namespace, systems: list[int]) -> None:
        self.systems, self.files = systems, dict[int, Path]()
        self.single: Path | None = None
        self.delays: dict[int, float] = {}
        self.needs = NO_NEEDS
        if args.action == "upload":
            self._missions(args.missions, args.sortie)
        if args.action in ("start", "check") and args.plan is not None:
            self._times(args.plan, args.sortie)
            self.needs = plan_needs(args.plan)

    def _missions(self, paths: Sequence[Path], sortie: int) -> None:
        named: dict[int, Path] = {}
        loose: list[Path] = []
        for path in paths:
            if path.is_dir():
                named |= {system: file for system, (file, _) in read_plan_folder(path, sortie).items()}
            elif not path.exists():
                raise InputError(f"{path} does not exist; give a folder made by 'orthoswarm plan', or a mission file")
            elif (number := number_in(path)) is not None and not (self.systems and len(paths) == 1):
                named[number] = path
            else:
                loose.append(path)
        if loose and (len(loose) > 1 or named):
            raise InputError(
                f"whose mission is {loose[0].name}? name files v1.plan, v2.plan, ..., or give one with --vehicle"
            )
        if loose and self.systems:
            named = dict.fromkeys(self.systems, loose[0])
        elif loose:
            self.single = loose[0]
            return
        if self.systems:
            missing = sorted(set(self.systems) - set(named))
            if missing:
                raise InputError(
                    f"there is no mission for vehicle {missing[0]} among the files; name it v{missing[0]}.plan"
                )
            named = {system: named[system] for system in self.systems}
        self.files, self.systems = named, sorted(named)

    def _times(self, folder: Path, sortie: int) -> None:
        flights = read_plan_folder(folder, sortie)
        first = min(start for _, start in flights.values())
        delays = {system: start - first for system, (_, start) in flights.items()}
        self.files = {system: file for system, (file, _) in flights.items()}
        self.delays = {s: d for s, d in delays.items() if not self.systems or s in self.systems}
        if not self.delays:
            raise InputError(
                f"the plan in {folder} is for vehicles {', '.join(map(str, sorted(delays)))}; change --vehicle"
            )
        self.systems = sorted(self.delays)


def parse_systems(texts: Sequence[str]) -> list[int]:
    """System ids in `3`, `v3` or `1,2,5`; raises InputError: not a system id."""
    systems: list[int] = []
    for text in texts:
        for part in text.split(","):
            match = re.fullmatch(r"v?(\d{1,3})", part.strip())
            if not match or not 1 <= int(match[1]) <= 255:
                raise InputError(f"'{part}' is not a vehicle; give system ids as in --vehicle 3 or --vehicle 1,2,5")
            systems.append(int(match[1]))
    return sorted(set(systems))


# --- actions ---


def _list(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    vehicles = [v for v in backend.summaries() if not prepared.systems or v["system"] in prepared.systems]
    if args.json:
        print(json.dumps({"vehicles": vehicles, "problems": backend.problems()}))
        return 0
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for column in ("vehicle", "autopilot", "doing", "mode", "height", "batt.", "GPS", "mission"):
        table.add_column(column, no_wrap=True)
    for v in vehicles:
        items = v["mission"]["items"]
        battery = "" if v["battery"] is None else f"{100 * v['battery']:.0f} %"
        armed = ", armed" if v["armed"] and v["flight"]["state"] == "on ground" else ""
        table.add_row(
            v["id"], v["autopilot"], v["flight"]["text"] + armed, v["mode"], f"{v['height_m']:.1f} m", battery,
            str(v["satellites"] or ""), f"{items} items" if items else "none",
        )  # fmt: skip
    Console().print(table)
    if len({link for v in vehicles for link in v["links"]}) > 1:
        for v in vehicles:
            print(f"{v['id']} on {', '.join(v['links']) or v['link']}")
    for problem in backend.problems():
        print(f"orthoswarm: {problem}", file=sys.stderr)
    return 0


def _upload(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    from gcs_plugin.mission.exchange import Outcome
    from gcs_plugin.mission.mission_builder import read_mission

    files = prepared.files
    if prepared.single is not None:
        if len(found) > 1:
            raise InputError(
                f"{len(found)} vehicles are heard; say which one gets {prepared.single.name} with --vehicle"
            )
        files = {found[0]: prepared.single}
    missions = {s: read_mission(path, backend.autopilot(s)) for s, path in files.items() if s in found}
    outcomes = {
        s: Outcome(ok=False, text=f"vehicle {s} was not heard; check its link and system id")
        for s in files
        if s not in found
    }
    outcomes |= _with_bar(lambda report: backend.upload(missions, report))
    lengths = {s: {"items": len(m), "file": str(files[s])} for s, m in missions.items()}
    return _report(args, outcomes, lengths)


def _command(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    from gcs_plugin.mission.track import Airspace

    systems = prepared.systems or found
    missing = [s for s in systems if s not in found]
    if missing and args.action == "start":
        names = ", ".join(map(str, missing))
        raise InputError(
            f"vehicle {names} was not heard, so no vehicle was started; check its link, or leave it out with --vehicle"
        )
    heard = [s for s in systems if s in found]
    standing = {s: backend.vehicle(s).standing for s in heard}  # before the checks: nothing may change during them
    if args.action == "resume":  # where one was held on its mission tells what was paused
        _with_bar(lambda report: backend.stored([s for s in heard if backend.vehicle(s).mission is None], report))
    airspace, flown = None, dict[int, "Mission"]()
    if args.action in ("start", "continue"):
        flown, refused = _ready(backend, args, prepared, heard)
        if refused:
            return _report(args, refused, {})
        airspace = Airspace.of(flown, needs=prepared.needs) if args.action == "start" else None
    orders, told = _unheard(args, missing), list(backend.events)
    watches = args.action == "start" and args.watch

    def pump(seconds: float) -> None:
        backend.pump(seconds)
        if watches:
            _tell(args, backend.events[len(told) :], heard, told)

    orders |= backend.command(
        args.action, {s: prepared.delays.get(s, 0.0) for s in heard}, lambda line: _say(args, line), airspace,
        standing=standing, missions=flown, pump=pump,
    )  # fmt: skip
    outcomes = _outcomes(orders)
    followed = [s for s, outcome in outcomes.items() if outcome.ok]
    if watches and followed:
        return _follow(backend, args, followed, all(outcome.ok for outcome in outcomes.values()), told)
    return _report(args, outcomes, _ids(orders), said=True)


def _as_they_are_heard(backend: "Backend", args: argparse.Namespace) -> int:
    """Pause, return or land all: each is told at once as it is heard, nobody waits until all were found."""
    from gcs_plugin.config import HEARING
    from gcs_plugin.fleet.commands import Order

    orders, said = dict[int, Order](), set[int]()
    last = time.monotonic()
    while True:
        backend.look()
        backend.pump(_STEP_S)
        now = time.monotonic()
        for system in [s for s in backend.vehicles() if s not in orders]:
            orders[system], last = backend.order(Order(verb=args.action, system=system, given_s=now)), now
        for system in [s for s, order in orders.items() if order.outcome is not None and s not in said]:
            said.add(system)
            outcome = orders[system].outcome
            _say(args, outcome.text if outcome is not None else "")
        if len(said) == len(orders) and now - last > (HEARING.all_found_s if orders else args.wait):
            break
    if not orders:
        return _nobody(backend, args, [], [])
    return _report(args, _outcomes(orders), _ids(orders), said=True)


def _return_in_turn(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    """Send vehicles home in turn; those that wait when it is interrupted, or takes too long, hold."""
    from gcs_plugin.backends.in_turn import InTurn

    if prepared.systems:  # the others are kept apart from, too
        found = backend.discover(args.wait)
    systems = prepared.systems or found
    orders = _unheard(args, [s for s in systems if s not in found])
    turn = InTurn(backend, lambda line: _say(args, line))
    try:
        turn.run([s for s in systems if s in found], args.seconds)
    finally:  # Ctrl-C ends the order: what it has come to is said all the same
        outcomes = _outcomes(orders) | turn.outcomes()
        code = _report(args, outcomes, _ids(orders | turn.orders), said=True)
    return code


def _unheard(args: argparse.Namespace, systems: Sequence[int]) -> "dict[int, Order]":
    """The command to vehicles that were not heard: said at once, and not sent."""
    from gcs_plugin.fleet.commands import Order
    from gcs_plugin.mission.exchange import Verdict

    orders = {}
    for s in systems:
        text = f"vehicle {s} was not heard; check its link and system id"
        orders[s] = Order(verb=args.action, system=s, given_s=time.monotonic()).end(text, Verdict.NOT_SENT)
        _say(args, text)
    return orders


def _outcomes(orders: "Mapping[int, Order]") -> "dict[int, Outcome]":
    """The outcomes that there are."""
    return {s: order.outcome for s, order in orders.items() if order.outcome is not None}


def _ids(orders: "Mapping[int, Order]") -> dict[int, dict[str, Any]]:
    return {s: {"command": order.verb, "command_id": order.id} for s, order in orders.items()}


def _say(args: argparse.Namespace, text: str) -> None:
    """Print a line of progress; with --json not on stdout, which is for the result."""
    print(text, file=sys.stderr if args.json else sys.stdout, flush=True)


def _ready(
    backend: "Backend", args: argparse.Namespace, prepared: _Prepared, systems: list[int]
) -> "tuple[dict[int, Mission], dict[int, Outcome]]":
    """Wait until all vehicles have passed their check; returns their missions, and why none was sent on."""
    from gcs_plugin.fleet.preflight import CONTINUED, ITEMS, Level, red_text
    from gcs_plugin.mission.exchange import Outcome, Verdict

    allowed = _overrides(args.override, systems, ITEMS)
    if args.action == "continue":
        allowed = {s: items | (set(ITEMS) - CONTINUED) for s, items in allowed.items()}
    missions, stored, look = _look(backend, args, prepared, systems)
    end = time.monotonic() + args.ready
    said: dict[int, str] = {}
    while True:
        checks = look()
        red = red_text(checks, allowed)
        waits = all(item.name in _PASSING for check in checks for item in check.red(allowed.get(check.system, ())))
        if not red or not waits or time.monotonic() >= end:
            break
        for line in _changes(said, red):
            _say(args, line)
        said = red
        backend.pump(0.5)
    if red:
        not_sent = "was not started" if args.action == "start" else "was not sent on"
        refused = {}
        for s in systems:
            why, failure = (red[s], Verdict.REFUSED) if s in red else ("others are not ready", Verdict.NOT_SENT)
            refused[s] = Outcome(ok=False, text=f"vehicle {s} {not_sent}: {why}", failure=failure)
        return {}, refused
    for check in checks:
        for item in check.items:
            if item.level is Level.WARNING and item.name not in _PASSING:
                _say(args, f"warning: v{check.system} {item.name}: {item.reason}")
    return {s: m for s in systems if (m := missions.get(s) or stored.get(s)) is not None}, {}


def _changes(before: Mapping[int, str], red: Mapping[int, str]) -> list[str]:
    """A line for each reason that vehicles have got, and one for those that have become ready."""
    changed: dict[str, list[str]] = {}
    for system, why in sorted(red.items()):
        if before.get(system) != why:
            changed.setdefault(why, []).append(f"v{system}")
    lines = [f"waiting: {', '.join(names)} {why}" for why, names in changed.items()]
    ready = [f"v{system}" for system in sorted(before.keys() - red.keys())]
    return [*lines, f"ready: {', '.join(ready)}"] if ready else lines


def _look(
    backend: "Backend", args: argparse.Namespace, prepared: _Prepared, systems: list[int]
) -> "tuple[dict[int, Mission], dict[int, Mission], Callable[[], list[Check]]]":
    """The plan's missions, those that the vehicles hold, and the check of all, which may be repeated."""
    from gcs_plugin.mission.mission_builder import read_mission

    missions = {s: read_mission(prepared.files[s], backend.autopilot(s)) for s in systems if s in prepared.files}
    stored = _with_bar(lambda report: backend.stored(systems, report))
    held = {s: mission for s, mission in stored.items() if mission is not None}
    starts = {s: prepared.delays.get(s, 0.0) for s in systems}
    zones = _with_bar(lambda report: backend.zones(systems, report))
    backend.hear_states(systems, args.wait)
    check = partial(backend.check, systems, missions, held, starts, args.max_height, needs=prepared.needs, zones=zones)
    return missions, held, check


def _overrides(texts: Sequence[str], systems: Sequence[int], items: Sequence[str]) -> dict[int, set[str]]:
    """The items that do not stop a start, by vehicle."""
    allowed: dict[int, set[str]] = {system: set() for system in systems}
    for text in texts:
        who, _, item = text.rpartition(":")
        if item not in items:
            raise InputError(f"'{text}' names no item of the check; choose from {', '.join(items)}")
        for system in parse_systems([who]) if who else systems:
            allowed.setdefault(system, set()).add(item)
    return allowed


def _check(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    """Show the check of each vehicle; 0 if none has a red item."""
    systems = [s for s in prepared.systems or found if s in found]
    checks = _look(backend, args, prepared, systems)[2]()
    if args.json:
        print(json.dumps({"vehicles": [check.document(f"v{check.system}") for check in checks]}))
    else:
        for check in checks:
            for item in check.items:
                print(f"v{check.system}  {item.level.value:<8} {item.name:<11} {item.reason}")
    return 0 if not any(check.red() for check in checks) else 1


def _watch(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    return _follow(backend, args, prepared.systems or found, True, [])


def _tell(
    args: argparse.Namespace, events: "Sequence[FleetEvent]", systems: Sequence[int], told: "list[FleetEvent]"
) -> None:
    """Print new events of vehicles, with --json nothing; all have been told then."""
    for event in events:
        if event.system in systems and not args.json:
            print(event.text, flush=True)
    told += events


def _follow(
    backend: "Backend", args: argparse.Namespace, systems: list[int], good: bool, told: "list[FleetEvent]"
) -> int:
    """Print events until all missions have ended, without those that were told; with --json all at once at the end."""
    reported, known = list["FleetEvent"](), {id(event) for event in told}
    print(f"following {', '.join(f'v{s}' for s in systems)}; Ctrl-C ends it, not the flights", file=sys.stderr)

    def tell(event: "FleetEvent") -> None:
        reported.append(event)
        if not args.json and id(event) not in known:
            print(event.text, flush=True)

    ended = backend.watch(systems, args.seconds, tell)
    complete = {event.system for event in reported if event.kind == "complete"}
    if args.json:
        events = [{"kind": e.kind, "vehicle": f"v{e.system}", "time_s": e.time_s, "text": e.text} for e in reported]
        vehicles = [v for v in backend.summaries() if v["system"] in systems]
        print(json.dumps({"ended": ended, "vehicles": vehicles, "events": events}))
    return 0 if good and ended and complete >= set(systems) else 1


def _report(
    args: argparse.Namespace, outcomes: "dict[int, Outcome]", more: dict[int, dict[str, Any]], *, said: bool = False
) -> int:
    """Print the outcome for each vehicle, unless printed before; 0 if all succeeded."""
    if args.json:
        rows = [
            {
                "id": f"v{s}", "system": s, "ok": outcome.ok, "outcome": outcome.verdict.value, "text": outcome.text,
                **_refusal(outcome), **more.get(s, {}),
            }
            for s, outcome in sorted(outcomes.items())
        ]  # fmt: skip
        print(json.dumps({"vehicles": rows}))
    elif not said:
        for _, outcome in sorted(outcomes.items()):
            print(outcome.text, file=sys.stdout if outcome.ok else sys.stderr)
    return 0 if outcomes and all(outcome.ok for outcome in outcomes.values()) else 1


def _refusal(outcome: "Outcome") -> dict[str, Any]:
    """The details of a vehicle's refusal."""
    if outcome.code is None:
        return {}
    return {"refusal": {"code": outcome.code, "item": outcome.item, "field": outcome.field}}


def _with_bar(work: Any) -> Any:
    from gcs_plugin.cli.arguments import ProgressBars

    with ProgressBars() as bars:
        return work(bars)


def _nobody(backend: "Backend", args: argparse.Namespace, wanted: list[int], found: list[int]) -> int:
    links = ", ".join(args.link or [DEFAULT_LINK])
    heard = f"; heard: {', '.join(map(str, found))}" if found else ""
    who = f"vehicle {', '.join(map(str, wanted))}" if wanted else "no vehicle"
    text = f"{who} {'not ' if wanted else ''}heard on {links} in {args.wait:g} s{heard}; check links and system ids"
    if args.json:
        print(json.dumps({"vehicles": [], "problems": [text, *backend.problems()]}))
    for line in [text, *backend.problems()]:
        print(f"orthoswarm: {line}", file=sys.stderr)
    return 1
