"""Plans made over HTTP: a folder each in the workspace, with the same files as `orthoswarm plan` writes."""

import contextlib
import json
import re
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.jobs.worker_pool import Crew
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.items import Mission
from orthoswarm.model.errors import InputError

_NAME: Final = re.compile(r"[0-9a-z][0-9a-z-]{0,63}\Z")
_NUMBERS: Final = {
    "altitude_m": "--altitude", "fov_min_deg": "--fov-min", "speed_m_s": "--speed", "endurance_min": "--endurance",
    "side_overlap": "--side-overlap", "forward_overlap": "--forward-overlap", "separation_m": "--separation",
    "clearance_m": "--clearance",
}  # fmt: skip
_CHOICES: Final = {
    "method": ("columns", "bcd", "tmstc"), "autopilot": ("ardupilot", "px4"), "end": ("rtl", "land", "hover"),
}  # fmt: skip


class Plans:
    """The plans of a workspace.

    Args:
        folder: where they are.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self, body: Mapping[str, Any], crew: Crew) -> dict[str, Any]:
        """Plan; gives the figures of `orthoswarm plan --json` with the plan's `id`.

        Raises:
            InputError: the area or a value is of no use.
        """
        arguments = _arguments(body)
        area = body.get("area")
        if not isinstance(area, dict):
            raise InputError("area is missing; send a GeoJSON polygon")
        name = f"plan-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{time.time_ns() % 10**6:06d}"
        path = self.folder / name
        path.mkdir(parents=True)
        try:
            (path / "area.geojson").write_text(json.dumps(area), encoding="utf-8")
            figures: dict[str, Any] = crew.run(plan_into, (path, arguments)) | {"id": name}
        except BaseException:
            shutil.rmtree(path, ignore_errors=True)
            raise
        return figures

    def all(self) -> list[dict[str, Any]]:
        """The figures of all plans, oldest first."""
        found = []
        for path in sorted(self.folder.glob("plan-*/plan.json")):
            with contextlib.suppress(ValueError):  # not written to its end: nobody was told of it
                found.append(json.loads(path.read_text(encoding="utf-8")) | {"id": path.parent.name})
        return found

    def geojson(self, name: str) -> bytes:
        """A plan as GeoJSON.

        Raises:
            InputError: there is no such plan.
        """
        return (self._path(name) / "all.geojson").read_bytes()

    def mission(self, body: Mapping[str, Any], vehicle: str, autopilot: Autopilot) -> Mission:
        """The mission that an upload asks for: `plan` with `mission` (the vehicle's own if not said), or `text`.

        Raises:
            InputError: there is none, or the text is no mission file.
        """
        from gcs_plugin.mission.mission_builder import build_mission, read_mission
        from gcs_plugin.mission.mission_files import parse_mission

        if isinstance(body.get("text"), str):
            parsed = parse_mission(body["text"], "the mission")
            return build_mission(autopilot, parsed.items, parsed.home, "the mission")
        folder = self._path(body.get("plan"))
        name = body.get("mission", vehicle)
        if not isinstance(name, str) or not _NAME.match(name):
            raise InputError("mission is no name of a mission; send for example v1")
        for path in (folder / f"{name}.waypoints", folder / f"{name}-sortie1.waypoints"):
            if path.is_file():
                return read_mission(path, autopilot)
        raise InputError(f"{folder.name} has no mission {name}; see /api/plans")

    def starts(self, name: Any, sortie: int = 1) -> dict[str, float]:
        """Vehicle -> takeoff of a flight in seconds after the swarm's start.

        Raises:
            InputError: there is no such plan or flight.
        """
        figures = json.loads((self._path(name) / "plan.json").read_text(encoding="utf-8"))
        flights = {v["id"]: v["flights"] for v in figures["vehicles"]}
        starts = {v: float(rows[sortie - 1]["start_s"]) for v, rows in flights.items() if len(rows) >= sortie}
        if not starts:
            most = max(len(rows) for rows in flights.values())
            raise InputError(f"{name} has no sortie {sortie} (there are {most}); send another")
        return starts

    def _path(self, name: Any) -> Path:
        if not isinstance(name, str) or not _NAME.match(name) or not (self.folder / name / "plan.json").is_file():
            raise InputError("there is no such plan; see /api/plans")
        return self.folder / name


def _arguments(body: Mapping[str, Any]) -> list[str]:
    """The request's values as arguments of `orthoswarm plan`."""
    count = body.get("vehicles")
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= 250:
        raise InputError("vehicles is missing; send a number from 1 to 250")
    arguments = ["--vehicles", str(count)]
    for key, flag in _NUMBERS.items():
        value = body.get(key)
        if value is None and key not in ("altitude_m", "fov_min_deg"):
            continue
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{key} is missing or no number; send one")
        arguments.append(f"{flag}={value!r}")
    for key, choices in _CHOICES.items():
        if key in body:
            if body[key] not in choices:
                raise InputError(f"{key} is none of {', '.join(choices)}; choose one")
            arguments += [f"--{key}", body[key]]
    starts = body.get("starts", [])
    if not isinstance(starts, list):
        raise InputError("starts is no list of [latitude, longitude]; send one")
    for start in starts:
        good = isinstance(start, list | tuple) and len(start) == 2 and all(isinstance(v, int | float) for v in start)
        if not good:
            raise InputError("starts is no list of [latitude, longitude]; send one")
        arguments.append(f"--start={float(start[0])!r},{float(start[1])!r}")
    return arguments


def plan_into(task: tuple[Path, list[str]]) -> dict[str, Any]:
    """Plan in a worker and write the folder; gives the figures."""
    import argparse

    from gcs_plugin.cli.verbs import plan as command
    from gcs_plugin.plans.plan_files import geojson, mission_files, report, write_folder

    folder, arguments = task
    parser = argparse.ArgumentParser(exit_on_error=False)
    command.configure(parser)
    args = parser.parse_args([str(folder / "area.geojson"), "--out", str(folder), *arguments])
    plan, area = command.make_plan(args)
    figures = report(plan, args.autopilot)
    files: dict[str, str | bytes] = dict(mission_files(plan, args.autopilot))
    files["all.geojson"] = geojson(plan, area)
    files["plan.json"] = json.dumps(figures, indent=1) + "\n"
    write_folder(folder, files)
    return figures
