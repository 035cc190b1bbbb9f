"""Commands to a running daemon, words in and lines out, for consoles such as MAVProxy's."""

import contextlib
import json
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

_USAGE: Final = (
    "usage: orthoswarm status|vehicles|plan|upload|start|pause|resume|continue|rtl|return|land|refine|layers|export|"
    "web|connect"
)
_TIMEOUT_S: Final = 240.0


class Client:
    """Talks to the daemon at a url (no slash at the end); commands need its token.

    `certificate` is the daemon's if it is served over TLS: its file, or the workspace that has its own one.
    """

    def __init__(
        self, url: str = "http://127.0.0.1:8650", token: str = "", certificate: Path | None = None
    ) -> None:  # fmt: skip
        self.url, self.token, self.certificate = url.rstrip("/"), token, certificate

    def ask(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """The JSON answer of a route; errors as of `fetch`."""
        try:
            return json.loads(self.fetch(path, body))
        except ValueError:
            raise RuntimeError(f"what answers at {self.url} is not a daemon; use 'orthoswarm connect'") from None

    def fetch(self, path: str, body: dict[str, Any] | None = None) -> bytes:
        """The answer of a route as it is; a POST if there is a body.

        Raises:
            RuntimeError: the daemon refused, or is not there, with a sentence for the user.
        """
        request = urllib.request.Request(self.url + path, method="GET" if body is None else "POST")
        request.add_header("Authorization", f"Bearer {self.token}")
        data = None
        if body is not None:
            request.add_header("Content-Type", "application/json")
            data = json.dumps(body).encode()
        try:
            opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), *self._encryption())
            with opener.open(request, data, timeout=_TIMEOUT_S) as answer:
                return bytes(answer.read())
        except urllib.error.HTTPError as error:
            raise RuntimeError(_detail(error)) from None
        except (OSError, ValueError) as error:
            raise RuntimeError(
                f"the daemon at {self.url} does not answer ({error}); start one with 'orthoswarm serve', "
                "or connect to another"
            ) from None

    def _encryption(self) -> list[urllib.request.HTTPSHandler]:
        """What trusts the daemon's certificate and no other; nothing where it is not known."""
        from gcs_plugin.web.certificate import CERTIFICATE, client_context

        if self.certificate is None or not self.url.startswith("https"):
            return []
        file = self.certificate / CERTIFICATE if self.certificate.is_dir() else self.certificate
        return [urllib.request.HTTPSHandler(context=client_context(file))]


def _detail(error: urllib.error.HTTPError) -> str:
    try:
        return str(json.loads(error.read())["detail"])
    except (OSError, ValueError, KeyError, TypeError):
        return f"the daemon answered {error.code}"


def _vehicle(row: dict[str, Any]) -> str:
    """A vehicle in a line: its mode, how many pictures there are, and how far they are placed."""
    counts: dict[str, int] = row.get("frames") or {}
    named = (("fine", "refined"), ("coarse", "coarse"), ("rejected", "rejected"))
    pictures = [f"{counts.get('frames', 0)} pictures", *(f"{counts[k]} {text}" for k, text in named if counts.get(k))]
    doing = (row.get("flight") or {}).get("text") or row.get("mode") or row["state"]
    return f"{row['id']}: {doing}, sortie {row.get('sortie')}, {', '.join(pictures)}"


class Commands:
    """The module's commands: words in, lines for the console out."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._plan = ""
        self._said: dict[str, str] = {}
        self._waits: set[str] = set()
        self._verbs: dict[str, Callable[[list[str]], list[str]]] = {
            "status": self.status, "vehicles": self.vehicles, "plan": self.plan, "upload": self.upload,
            "start": self.start, "pause": self.command("pause"), "resume": self.command("resume"),
            "continue": self.command("continue"), "rtl": self.command("rtl"), "return": self.return_in_turn,
            "land": self.command("land"),
            "refine": self.refine, "layers": self.layers, "export": self.export, "web": self.web,
            "connect": self.connect,
        }  # fmt: skip

    def run(self, words: list[str]) -> list[str]:
        """Do what was typed."""
        if not words or words[0] not in self._verbs:
            return [_USAGE]
        try:
            return self._verbs[words[0]](words[1:])
        except (RuntimeError, ValueError, OSError) as error:
            return [f"orthoswarm: {error}"]

    def connect(self, words: list[str]) -> list[str]:
        """`connect URL TOKEN`, or `connect WORKSPACE` with the token in its file."""
        if len(words) == 1 and Path(words[0]).is_dir():
            workspace = Path(words[0])
            self.client.token = (workspace / "token").read_text().strip()
            with contextlib.suppress(OSError):
                self.client.url = (workspace / "address").read_text().strip().rstrip("/")
            self.client.certificate = workspace
        elif len(words) == 2:
            self.client.url, self.client.token = words[0].rstrip("/"), words[1]
        else:
            return ["usage: orthoswarm connect URL TOKEN, or orthoswarm connect WORKSPACE"]
        return self.status([])

    def status(self, _: list[str]) -> list[str]:
        """Health, frames and jobs."""
        health, jobs = self.client.ask("/healthz"), self.client.ask("/api/jobs")
        rows = self.client.ask("/api/vehicles")
        frames = sum(row.get("frames", {}).get("frames", 0) for row in rows)
        under_way = [
            f"{j['kind']} {j['vehicle'] or ''} {100 * j['progress']:.0f} %" for j in jobs if j["state"] == "running"
        ]
        lines = [f"daemon {health['version']} at {self.client.url}: {len(rows)} vehicles, {frames} pictures"]
        return [*lines, *under_way, *health["problems"]]

    def vehicles(self, _: list[str]) -> list[str]:
        """A line a vehicle."""
        return [_vehicle(row) for row in self.client.ask("/api/vehicles")]

    def layers(self, _: list[str]) -> list[str]:
        """A line a layer."""
        return [f"{r['name']}: {'empty' if r['empty'] else r['version']}" for r in self.client.ask("/api/layers")]

    def plan(self, words: list[str]) -> list[str]:
        """`plan AREA.geojson VEHICLES HEIGHT FOV_MIN`."""
        if len(words) != 4:
            return ["usage: orthoswarm plan AREA.geojson VEHICLES HEIGHT_M FOV_MIN_DEG"]
        body = {
            "area": json.loads(Path(words[0]).read_text()), "vehicles": int(words[1]), "altitude_m": float(words[2]),
            "fov_min_deg": float(words[3]),
        }  # fmt: skip
        figures = self.client.ask("/api/plans", body)
        self._plan = figures["id"]
        warned = [f"warning: {text}" for text in figures.get("warnings", [])]
        covered, minutes = 100 * figures["covered_share"], figures["makespan_s"] / 60
        return [f"{self._plan}: {covered:.1f} % covered in {minutes:.1f} min", *warned]

    def upload(self, words: list[str]) -> list[str]:
        """`upload VEHICLE [PLAN]`."""
        if not words or not (self._plan or len(words) > 1):
            return ["usage: orthoswarm upload VEHICLE [PLAN]; plan first"]
        plan = words[1] if len(words) > 1 else self._plan
        return [self.client.ask(f"/api/missions/{self._named(words[0])}/upload", {"plan": plan})["reason"]]

    def _named(self, word: str) -> str:
        """The daemon's name of a vehicle that was typed as its name or as its system id."""
        if not word.isdigit():
            return word
        rows = self.client.ask("/api/vehicles")
        return next((str(row["id"]) for row in rows if str(row.get("system")) == word), f"v{word}")

    def news(self) -> list[str]:
        """What happened since the last call: takeoffs that failed or are held, vehicles too near each other, turns."""
        try:
            rows = self.client.ask("/api/vehicles")
        except RuntimeError:
            return []
        found = {f"{row['id']} takeoff": (row.get("takeoff") or {}).get("failed") or "" for row in rows}
        alarms = {row.get("alarm") or "" for row in rows} - {""}
        found |= {f"alarm {text.split(' are ')[0]}": text for text in alarms}
        new = [f"{who.split()[0]}: {text}" if not who.startswith("alarm") else text for who, text in found.items()
               if text and who not in self._said]  # fmt: skip
        self._said = {who: text for who, text in found.items() if text}
        waits = {str(row["id"]) for row in rows if row.get("returns_after") is not None}
        new += [
            f"{name} waits no longer: it is told to return, has landed, or follows another command; see 'vehicles'"
            for name in sorted(self._waits - waits)
        ]
        self._waits = waits
        return new

    def start(self, words: list[str]) -> list[str]:
        """`start VEHICLE` at once, or `start PLAN`: its vehicles at its times."""
        if len(words) != 1:
            return ["usage: orthoswarm start VEHICLE, or start PLAN for its vehicles at its times"]
        if not words[0].startswith("plan-"):
            return self.command("start")(words)
        waits = self.client.ask(f"/api/plans/{words[0]}/start", {})["takeoffs_in_s"]
        return [f"{vehicle} takes off in {seconds:.0f} s" for vehicle, seconds in sorted(waits.items())]

    def command(self, verb: str) -> Callable[[list[str]], list[str]]:
        """A command to a vehicle."""

        def run(words: list[str]) -> list[str]:
            if len(words) != 1:
                return [f"usage: orthoswarm {verb} VEHICLE"]
            return [self.client.ask(f"/api/missions/{self._named(words[0])}/{verb}", {})["reason"]]

        return run

    def return_in_turn(self, words: list[str]) -> list[str]:
        """`return`: all vehicles, those whose ways home come near each other one after the other."""
        if words:
            return ["usage: orthoswarm return, for all vehicles in turn; rtl VEHICLE sends one home at once"]
        rows = self.client.ask("/api/missions/all/return", {})["results"]
        return [str(row["reason"]) for row in rows] or ["no vehicle is on the links"]

    def refine(self, words: list[str]) -> list[str]:
        """`refine [VEHICLE]`."""
        jobs = self.client.ask("/api/refine", {"vehicle": words[0]} if words else {})
        return [f"refining {job['vehicle']}, sortie {job['sortie']} (job {job['id']})" for job in jobs]

    def export(self, words: list[str]) -> list[str]:
        """`export [FORMAT ...]`."""
        job = self.client.ask("/api/export", {"formats": words} if words else {})
        return [f"exporting {', '.join(job['detail']['formats'])} (job {job['id']})"]

    def web(self, _: list[str]) -> list[str]:
        """Where the page is."""
        return [f"{self.client.url}/"]
