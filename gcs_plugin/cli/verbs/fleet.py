"""`orthoswarm fleet`: the vehicles on the links - list them, upload missions, start, pause, resume, RTL, watch."""

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthoswarm.model.errors import InputError

if TYPE_CHECKING:
    from gcs_plugin.backends import Backend
    from gcs_plugin.fleet.fleet_events import FleetEvent
    from gcs_plugin.mission.exchange import Outcome

_WAIT_S = 8.0
_DEFAULT_LINK = "udpin:0.0.0.0:14550"
_VERBS = {
    "list": "show the vehicles",
    "upload": "put missions into vehicles and read them back",
    "start": "let vehicles fly their missions from the beginning (mode, arm, start)",
    "pause": "let vehicles stay where they are",
    "resume": "let vehicles go on with their missions",
    "rtl": "let vehicles fly home and land",
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
    "rtl": "orthoswarm fleet rtl --link udpin:0.0.0.0:14550",
    "watch": "orthoswarm fleet watch --link udpin:0.0.0.0:14550 --seconds 1800",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "A link is udpin:HOST:PORT (listen), udpout:HOST:PORT, tcp:HOST:PORT, or serial:DEVICE:BAUD; give --link\n"
        f"again for more; without one, {_DEFAULT_LINK}. Nothing moves a vehicle but start, resume and rtl.\n\n"
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
        if name == "start":
            verb.add_argument("--plan", type=Path, metavar="DIR", help="folder of a plan: its vehicles, at its times")
            verb.add_argument("--sortie", type=int, default=1, metavar="N", help="which flight of the plan (default 1)")
            verb.add_argument("--watch", action="store_true", help="follow the missions until each has ended")
        if name in ("start", "watch"):
            verb.add_argument(
                "--seconds", type=float, default=7200.0, metavar="S", help="follow at most so long (default 7200)"
            )


def _common(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--link",
        action="append",
        default=[],
        metavar="URL",
        help=f"link to vehicles, several allowed ({_DEFAULT_LINK})",
    )
    add("--vehicle", action="append", default=[], metavar="ID", help="system ids: 3, v3, or 1,2,5 (default: all heard)")
    add("--wait", type=float, default=_WAIT_S, metavar="S", help=f"look for vehicles at most so long ({_WAIT_S:g})")
    add("--json", action="store_true", help="one JSON document on stdout")
    add("--backend", default="pymavlink", choices=["pymavlink", "mavsdk"], help="who talks to them (pymavlink)")
    add("--tlog", type=Path, metavar="FILE", help="append all packets to a telemetry log")
    add(
        "--signing-key",
        type=Path,
        metavar="FILE",
        help="key for signed MAVLink (or ORTHOSWARM_SIGNING_KEY_FILE, ORTHOSWARM_SIGNING_KEY)",
    )
    add("--gcs-system", type=int, default=255, metavar="ID", help="our own system id (255)")


def run(args: argparse.Namespace) -> int:
    """Open the links, do it, close them."""
    from gcs_plugin.backends import open_backend
    from gcs_plugin.links.signing import find_key
    from gcs_plugin.mission.exchange import Address

    if not 1 <= args.gcs_system <= 255:
        raise InputError(f"our system id cannot be {args.gcs_system}; give 1 to 255")
    for name, value in (("--wait", args.wait), ("--seconds", getattr(args, "seconds", 0.0))):
        if not value >= 0.0:
            raise InputError(f"{name} {value:g} is no time; give seconds, 0 or more")
    systems = parse_systems(args.vehicle)
    prepared = _Prepared(args, systems)
    backend = open_backend(
        args.backend,
        args.link or [_DEFAULT_LINK],
        own=Address(args.gcs_system, 190),
        key=find_key(args.signing_key),
        tlog=args.tlog,
    )
    try:
        found = backend.discover(args.wait, prepared.systems)
        if not found or (prepared.systems and not set(prepared.systems) & set(found)):
            return _nobody(backend, args, prepared.systems, found)
        actions = {"list": _list, "upload": _upload, "watch": _watch}
        return actions.get(args.action, _command)(backend, args, prepared, found)
    finally:
        backend.close()


class _Prepared:
    """What the arguments name, read before any link is opened.

    Attributes:
        systems: vehicles that are asked for, empty for all.
        files: mission file for each vehicle of an upload, or of a plan that is started; `single` a file for whichever
            vehicle is there.
        delays: seconds after the first takeoff for each vehicle of a plan.
    """

    def __init__(self, args: argparse.Namespace, systems: list[int]) -> None:
        self.systems, self.files = systems, dict[int, Path]()
        self.single: Path | None = None
        self.delays: dict[int, float] = {}
        if args.action == "upload":
            self._missions(args.missions, args.sortie)
        if args.action == "start" and args.plan is not None:
            self._times(args.plan, args.sortie)

    def _missions(self, paths: Sequence[Path], sortie: int) -> None:
        named: dict[int, Path] = {}
        loose: list[Path] = []
        for path in paths:
            if path.is_dir():
                named |= {system: file for system, (file, _) in read_plan_folder(path, sortie).items()}
            elif not path.exists():
                raise InputError(f"{path} does not exist; give a folder made by 'orthoswarm plan', or a mission file")
            elif (number := _number_in(path)) is not None and not (self.systems and len(paths) == 1):
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
    """System ids in `3`, `v3` or `1,2,5`.

    Raises:
        InputError: not a system id.
    """
    systems: list[int] = []
    for text in texts:
        for part in text.split(","):
            match = re.fullmatch(r"v?(\d{1,3})", part.strip())
            if not match or not 1 <= int(match[1]) <= 255:
                raise InputError(f"'{part}' is no vehicle; give system ids as in --vehicle 3 or --vehicle 1,2,5")
            systems.append(int(match[1]))
    return sorted(set(systems))


def read_plan_folder(folder: Path, sortie: int) -> dict[int, tuple[Path, float]]:
    """Mission file and takeoff time (seconds after the swarm's start) for each vehicle of a plan's folder.

    Args:
        folder: as `orthoswarm plan` writes it; without its report, files named v1.plan or v1.waypoints and so on.
        sortie: which flight, from 1; vehicles with fewer flights stay away.

    Raises:
        InputError: there is no such plan or flight.
    """
    report = folder / "plan.json"
    flights: dict[int, tuple[Path, float]] = {}
    most = 1
    try:
        document = json.loads(report.read_text(encoding="utf-8")) if report.exists() else None
        for vehicle in document["vehicles"] if document else []:
            most = max(most, len(vehicle["flights"]))
            if sortie <= len(vehicle["flights"]):
                flight = vehicle["flights"][sortie - 1]
                flights[int(str(vehicle["id"]).removeprefix("v"))] = (
                    folder / flight["files"][0],
                    float(flight["start_s"]),
                )
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        raise InputError(
            f"{report} is no report of a plan; plan again with: orthoswarm plan ... --out {folder}"
        ) from None
    if document is None:
        for path in sorted(folder.glob("*")):
            number = _number_in(path)
            if number is not None and (number not in flights or path.suffix == ".plan"):
                flights[number] = (path, 0.0)
    if sortie < 1 or not flights:
        why = (
            f"has no sortie {sortie} (there are {most})"
            if document
            else "holds no missions named v1.plan, v2.plan, ..."
        )
        raise InputError(f"{folder} {why}; plan with: orthoswarm plan ... --out {folder}")
    return flights


def _number_in(path: Path) -> int | None:
    match = re.fullmatch(r"v(\d{1,3})(?:-sortie1)?", path.stem)
    return int(match[1]) if match and path.suffix in (".plan", ".waypoints") else None


# --- actions ---


def _list(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    vehicles = [v for v in backend.summaries() if not prepared.systems or v["system"] in prepared.systems]
    if args.json:
        print(json.dumps({"vehicles": vehicles, "problems": backend.problems()}))
        return 0
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    several = len({v["link"] for v in vehicles}) > 1
    columns = ["vehicle", "autopilot", "state", "mode", "armed", "height", "battery", "GPS", "mission"]
    for column in [*columns, *(["link"] if several else [])]:
        table.add_column(column, no_wrap=True)
    for v in vehicles:
        mission = v["mission"]
        battery = "" if v["battery"] is None else f"{100 * v['battery']:.0f} %"
        progress = f"{mission['phase']} {mission['item']}/{mission['items']}" if mission["items"] else "none"
        table.add_row(
            v["id"], v["autopilot"], v["state"], v["mode"], "armed" if v["armed"] else "", f"{v['height_m']:.1f} m",
            battery, str(v["satellites"] or ""), progress, *([v["link"]] if several else []),
        )  # fmt: skip
    Console().print(table)
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
        s: Outcome(False, f"vehicle {s} was not heard; check its link and system id") for s in files if s not in found
    }
    outcomes |= _with_bar(lambda report: backend.upload(missions, report))
    lengths = {s: {"items": len(m), "file": str(files[s])} for s, m in missions.items()}
    return _report(args, outcomes, lengths)


def _command(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    from gcs_plugin.mission.exchange import Outcome

    systems = prepared.systems or found
    missing = [s for s in systems if s not in found]
    if missing and args.action == "start":
        names = ", ".join(map(str, missing))
        raise InputError(
            f"vehicle {names} was not heard, so nobody was started; check its link, or leave it out with --vehicle"
        )
    heard = [s for s in systems if s in found]
    if args.action == "start" and prepared.files:
        if unlike := _unlike_plan(backend, {s: prepared.files[s] for s in heard}):
            return _report(args, unlike, {})
    elif args.action == "start" and len(heard) > 1:
        print(
            f"starting {len(heard)} vehicles at once; missions of one plan keep apart only at the plan's times: "
            "start those with --plan DIR",
            file=sys.stderr,
        )
    delays = {s: prepared.delays.get(s, 0.0) for s in heard}
    outcomes = {s: Outcome(False, f"vehicle {s} was not heard; check its link and system id") for s in missing}
    outcomes |= _with_bar(lambda report: backend.command(args.action, delays, report))
    followed = [s for s, outcome in outcomes.items() if outcome.ok]
    if args.action == "start" and args.watch and followed:
        for text in (outcome.text for outcome in outcomes.values()):
            print(text, file=sys.stderr)
        return _follow(backend, args, followed, all(outcome.ok for outcome in outcomes.values()))
    return _report(args, outcomes, {})


def _unlike_plan(backend: "Backend", files: dict[int, Path]) -> "dict[int, Outcome]":
    """Does each vehicle hold its mission of the plan? Empty if all do; else how it stands with each of them.

    A broken upload leaves a mixture in ArduPilot, and an earlier plan's mission has other times and heights.
    """
    from gcs_plugin.mission.comparison import difference
    from gcs_plugin.mission.exchange import Outcome
    from gcs_plugin.mission.mission_builder import read_mission

    missions = {s: read_mission(path, backend.autopilot(s)) for s, path in files.items()}
    stored = _with_bar(lambda report: backend.stored(list(missions), report))
    wrong: dict[int, str] = {}
    for system, mission in missions.items():
        held = stored[system]
        found = difference(mission, held.items) if held is not None else None
        if held is None:
            wrong[system] = "does not hand out its mission; check the link"
        elif found is not None:
            wrong[system] = f"does not hold {mission.name} ({found.text}); upload the plan first"
    others = "was not started, because others do not hold this plan"
    return {s: Outcome(False, f"vehicle {s} {wrong.get(s, others)}") for s in missions} if wrong else {}


def _watch(backend: "Backend", args: argparse.Namespace, prepared: _Prepared, found: list[int]) -> int:
    return _follow(backend, args, prepared.systems or found, True)


def _follow(backend: "Backend", args: argparse.Namespace, systems: list[int], good: bool) -> int:
    """Tell events until all missions have ended; with --json all at once at the end."""
    told: list[FleetEvent] = []
    print(f"following {', '.join(f'v{s}' for s in systems)}; Ctrl-C ends it, not the flights", file=sys.stderr)

    def tell(event: "FleetEvent") -> None:
        told.append(event)
        if not args.json:
            print(event.text, flush=True)

    ended = backend.watch(systems, args.seconds, tell)
    complete = {event.system for event in told if event.kind == "complete"}
    if args.json:
        events = [{"kind": e.kind, "vehicle": f"v{e.system}", "time_s": e.time_s, "text": e.text} for e in told]
        vehicles = [v for v in backend.summaries() if v["system"] in systems]
        print(json.dumps({"ended": ended, "vehicles": vehicles, "events": events}))
    return 0 if good and ended and complete >= set(systems) else 1


def _report(args: argparse.Namespace, outcomes: "dict[int, Outcome]", more: dict[int, dict[str, Any]]) -> int:
    """Say how it went for each vehicle; 0 if well for all."""
    if args.json:
        rows = [
            {"id": f"v{s}", "system": s, "ok": outcome.ok, "text": outcome.text, **_refusal(outcome), **more.get(s, {})}
            for s, outcome in sorted(outcomes.items())
        ]
        print(json.dumps({"vehicles": rows}))
    else:
        for _, outcome in sorted(outcomes.items()):
            print(outcome.text, file=sys.stdout if outcome.ok else sys.stderr)
    return 0 if outcomes and all(outcome.ok for outcome in outcomes.values()) else 1


def _refusal(outcome: "Outcome") -> dict[str, Any]:
    """What a vehicle refused."""
    if outcome.code is None:
        return {}
    return {"refusal": {"code": outcome.code, "item": outcome.item, "field": outcome.field}}


def _with_bar(work: Any) -> Any:
    from gcs_plugin.cli.progress import ProgressBars

    with ProgressBars() as bars:
        return work(bars)


def _nobody(backend: "Backend", args: argparse.Namespace, wanted: list[int], found: list[int]) -> int:
    links = ", ".join(args.link or [_DEFAULT_LINK])
    heard = f"; heard: {', '.join(map(str, found))}" if found else ""
    who = f"vehicle {', '.join(map(str, wanted))}" if wanted else "no vehicle"
    text = f"{who} {'not ' if wanted else ''}heard on {links} in {args.wait:g} s{heard}; check links and system ids"
    if args.json:
        print(json.dumps({"vehicles": [], "problems": [text, *backend.problems()]}))
    for line in [text, *backend.problems()]:
        print(f"orthoswarm: {line}", file=sys.stderr)
    return 1
