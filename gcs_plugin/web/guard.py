"""Access control: who makes a request, whether that role may (`NEEDS`), and the log of what came of it.

The operator sends the daemon's token in a header, which no foreign form can set. People who were invited have a session
in a cookie (HttpOnly, SameSite=Strict, this host's alone); what changes something must then state its Origin, too.
Everybody else may do nothing; on this machine, or where the operator lets all read, they may read.

A page of another site cannot reach the daemon: a foreign Origin is refused (cross-site requests), but for the map
where the operator named it (`--allow-origin`), and so is a Host that is not the daemon's address (DNS rebinding; over
TLS no other name has the certificate).
"""

import contextlib
import hmac
import json
import os
import secrets
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

from starlette.routing import compile_path

from gcs_plugin.daemon.store.people_rows import NOBODY, OPERATOR, Deed, People, Person, Role
from orthoswarm.model.errors import InputError, OrthoSwarmError

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
_READER: Final = Person(-1, "", Role.VIEWER)
_MOST_REASON: Final = 4096  # bytes of a refusal, for the log
_SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
CONTENT_POLICY: Final = (
    "default-src 'self'; img-src 'self' blob: data:; worker-src 'self' blob:; style-src 'self' 'unsafe-inline';"
    " connect-src 'self'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"content-security-policy", CONTENT_POLICY.encode()),
]


class Need(NamedTuple):
    """What a route needs: a role; `action`: its word in the log, empty for what is not noted."""

    role: Role
    action: str = ""


EDIT_PLAN: Final = "edit plan"
_OPEN: Final = "/ /favicon.ico /healthz /static/{path:path} /api/me"
_READING: Final = """
    /docs /openapi.json /metrics /tiles/{layer}/{z}/{x}/{y}.{suffix} /tiles/{layer}.json /wmts
    /api/vehicles /api/layers /api/jobs /api/legs
    /api/completions /api/frames /api/routes /api/frames/{seq}/picture /api/frames/{seq}/view /api/plans
    /api/plans/{number}/map /api/plans/{number}/files/{drone} /api/plan /api/traffic /api/finds
    /api/finds/{number}/pictures /api/pictures /api/points /api/points/pictures /api/points/gcp_list.txt
    /api/places /api/trust /api/trust.png /api/change /api/change.png
    /api/coverage /api/coverage/gaps.geojson /api/coverage/cells.png /api/coverage/vehicles
    /api/export/{job}/{kind} /api/holds /api/log
"""
NEEDS: Final[dict[str, Need]] = {
    **{f"GET {path}": Need(Role.ANYBODY) for path in _OPEN.split()},
    **{f"GET {path}": Need(Role.VIEWER) for path in _READING.split()},
    "WS /api/events": Need(Role.VIEWER),
    "POST /api/session": Need(Role.ANYBODY),
    # areas, plans, finds, the map
    "POST /api/frames": Need(Role.ANALYST),
    "POST /api/areas": Need(Role.ANALYST),
    "POST /api/plans": Need(Role.ANALYST, "plan"),
    "PUT /api/plan": Need(Role.ANALYST, EDIT_PLAN),
    "POST /api/coverage/flight": Need(Role.ANALYST, "plan gaps"),
    "POST /api/finds": Need(Role.ANALYST, "find"),
    "PUT /api/finds/{number}": Need(Role.ANALYST, "change find"),
    "DELETE /api/finds/{number}": Need(Role.ANALYST, "remove find"),
    "PUT /api/points": Need(Role.ANALYST, "load points"),
    "POST /api/points/marks": Need(Role.ANALYST, "mark point"),
    "POST /api/refine": Need(Role.ANALYST, "refine"),
    "POST /api/export": Need(Role.ANALYST, "export"),
    # vehicles
    "POST /api/missions/{vehicle:path}/{verb}": Need(Role.PILOT, "command"),
    "POST /api/plans/{number}/preflight": Need(Role.PILOT, "check"),
    "POST /api/plans/{number}/start": Need(Role.PILOT, "start plan"),
    "DELETE /api/plans/{number}/start": Need(Role.PILOT, "cancel start"),
    "POST /api/holds/{vehicle:path}": Need(Role.PILOT, "hold"),
    # people
    "GET /api/people": Need(Role.OPERATOR),
    "POST /api/people": Need(Role.OPERATOR, "invite"),
    "DELETE /api/people/{number}": Need(Role.OPERATOR, "revoke"),
}
"""Method and path of each route -> what it needs."""

FOR_OTHER_SITES: Final = frozenset(
    {"GET /tiles/{layer}/{z}/{x}/{y}.{suffix}", "GET /tiles/{layer}.json", "GET /wmts", "GET /api/layers"}
)
"""What pages of the origins that the operator named may read (`serve --allow-origin`): the map, nothing else."""

LOCAL_PROGRAMS: Final = frozenset({"POST /api/frames", "POST /api/areas"})
"""What programs of this machine may send without the token: pictures, and area files to be read."""

_PATTERNS: Final = [(name, name.split(" ", 1)[0], compile_path(name.split(" ", 1)[1])[0]) for name in NEEDS]


def route_of(method: str, path: str) -> str:
    """The row of the table for a request ("GET /api/jobs"), or the request itself if it has none."""
    method = "GET" if method in ("HEAD", "OPTIONS") else method
    exact = f"{method} {path}"
    if exact in NEEDS:
        return exact
    return next((name for name, verb, pattern in _PATTERNS if verb == method and pattern.match(path)), exact)


def need_of(route: str) -> Need:
    """What a route of `route_of` needs; of one that is not in the table the most."""
    return NEEDS.get(route) or Need(Role.VIEWER if route.startswith("GET ") else Role.OPERATOR)


def take_token(path: Path) -> str:
    """The token in a file; a missing file is created with a new token.

    Raises:
        InputError: the file has no valid token, or cannot be read or written.
    """
    try:
        # an empty file is left by a power failure while it was written
        if path.exists() and path.read_bytes().strip(b"\0 \r\n"):
            token = path.read_text(encoding="ascii").strip()
            if len(token) < 8:
                raise InputError(f"{path} contains no token; put at least eight characters there, or remove it")
            return token
        token = secrets.token_urlsafe(24)
        write_secret(path, token.encode() + b"\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the token file {path} cannot be used ({error}); name another with --token-file") from None
    return token


def write_secret(path: Path, content: bytes) -> None:
    """Write a file that only its owner can read, and that appears when it is complete and on the disk.

    Raises:
        OSError: it cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


@dataclass(slots=True)
class Act:
    """A request under way, as `act_of` gives it to its route.

    Attributes:
        person: who makes it. deeds: what came of it where the route says so; else (None) the answer's status tells.
    """

    person: Person
    deeds: list[Deed] | None = None


def act_of(scope: Any) -> Act:
    """The act of a request that the guard has let through."""
    act: Act = scope["act"]
    return act


class Access(NamedTuple):
    """Who may reach the daemon: `lan`, over TLS from other machines; `open_reading`, all may read without a session.

    origins: of pages of other sites that may read the map.
    """

    token: str
    bind: str = "127.0.0.1"
    lan: bool = False
    open_reading: bool = False
    origins: frozenset[str] = frozenset()

    @property
    def is_local(self) -> bool:
        """Whether only programs of this machine reach it."""
        return not self.lan and self.bind.strip("[]") in LOOPBACK


class Guard:
    """ASGI middleware that passes requests on or refuses them.

    Args:
        app: the application.
        access: the token, and from where requests may come.
        people: the sessions, and the log.
    """

    def __init__(self, app: Any, access: Access, people: People) -> None:
        self.app, self._access, self._people = app, access, people
        self._hosts = LOOPBACK | {access.bind.strip("[]").lower()}
        self._anybody = _READER if access.is_local or access.open_reading else NOBODY

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """Handle one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers: dict[str, str] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), value.decode("latin-1"))
        method = "WS" if scope["type"] == "websocket" else scope["method"]
        route = route_of(method, scope["path"])
        need, sent = need_of(route), _sent_token(scope, headers)
        person = self._person(scope, headers, sent)
        other_site = self._other_site(route, headers)
        refusal = self._foreign(scope, headers, person, other_site) or self._missing_role(route, need, person, sent)
        if refusal is not None:
            await _refuse(scope, send, *refusal)
            return
        self._people.seen(person)
        scope["act"] = act = Act(person)
        if method == "WS":
            await self.app(scope, receive, self._while_allowed(send, person))
            return
        answer = _Answer(send, other_site)
        try:
            await self.app(scope, receive, answer)
        finally:
            if need.action and person.id >= 0:
                values = "/".join(map(str, scope.get("path_params", {}).values()))
                told = [Deed(need.action, values, *answer.outcome())]
                self._people.note(person, told if act.deeds is None else act.deeds, edit=need.action == EDIT_PLAN)

    def _person(self, scope: dict[str, Any], headers: dict[str, str], sent: str) -> Person:
        """Who makes a request: by the token, else by a session's cookie."""
        # latin-1 is what headers are decoded by; a token is ASCII
        if sent and hmac.compare_digest(sent.encode("utf-8", "replace"), self._access.token.encode()):
            return OPERATOR
        secret = _session(headers.get("cookie", ""), session_cookie(scope)) if self._access.lan else ""
        return (self._people.of_session(secret) if secret else None) or self._anybody

    def _other_site(self, route: str, headers: dict[str, str]) -> str:
        """The other site whose page may read what it asks for; "" if none asks, or may."""
        origin = headers.get("origin", "")
        return origin if origin.lower() in self._access.origins and route in FOR_OTHER_SITES else ""

    def _foreign(
        self, scope: dict[str, Any], headers: dict[str, str], person: Person, allowed: str
    ) -> tuple[int, str] | None:
        """Status and reason if a request comes from another site's page."""
        host = headers.get("host", "")
        if self._access.is_local and _host_name(host) not in self._hosts:
            return 403, "the Host header does not name this daemon; use the address that it printed"
        origin = headers.get("origin")
        if origin is not None and not allowed and not _is_same_site(origin, host, encrypted=self._access.lan):
            return 403, "pages of other sites may not use this daemon; open its own page"
        by_cookie = person.id > OPERATOR.id
        if by_cookie and origin is None and (scope["type"] == "websocket" or scope["method"] not in _SAFE):
            return 403, "a request with a session's cookie has to state its Origin; use the daemon's own page"
        return None

    def _missing_role(self, route: str, need: Need, person: Person, sent: str) -> tuple[int, str] | None:
        """Status and reason if a person may not make a request."""
        if person.role >= need.role or (self._access.is_local and route in LOCAL_PROGRAMS):
            return None
        if person.id > OPERATOR.id:
            word = need.role.word
            return 403, f"{person.name} is here as {person.role.word}, this takes a role of {word}; ask the operator"
        return _TOKEN_WRONG if sent else _TOKEN_MISSING

    def _while_allowed(self, send: Any, person: Person) -> Any:
        """A WebSocket's send that ends the connection of somebody who was revoked."""

        async def sending(message: dict[str, Any]) -> None:
            if person.id >= 0:
                if self._people.find(person.id) is None:
                    await send({"type": "websocket.close", "code": 1008, "reason": "revoked"})
                    raise RuntimeError("revoked")
                self._people.seen(person)
            await send(message)

        return sending


class _Answer:
    """An ASGI send that adds the headers of all answers, and remembers how the request ended."""

    def __init__(self, send: Any, other_site: str = "") -> None:
        self._send, self._status, self._text = send, 500, b""
        leave = [(b"access-control-allow-origin", other_site.encode("latin-1")), (b"vary", b"Origin")]
        self._headers = _HEADERS + leave if other_site else _HEADERS

    async def __call__(self, message: dict[str, Any]) -> None:
        """Send a part of the answer."""
        if message["type"] == "http.response.start":
            self._status = message["status"]
            own = list(message.get("headers", []))
            given = {name for name, _ in own}
            message = {**message, "headers": own + [row for row in self._headers if row[0] not in given]}
        elif self._status >= 400 and len(self._text) < _MOST_REASON:
            self._text += message.get("body", b"")
        await self._send(message)

    def outcome(self) -> tuple[str, str]:
        """`done`, or `refused` with the reason."""
        if self._status < 400:
            return "done", ""
        with contextlib.suppress(ValueError, KeyError, TypeError):
            return "refused", str(json.loads(self._text)["detail"])
        return "refused", f"status {self._status}"


def session_cookie(scope: Any) -> str:
    """The name of the session's cookie: of this host alone, and of this port, since cookies know no ports."""
    return f"__Host-orthoswarm-{(scope.get('server') or ('', 0))[1]}"


def _session(cookies: str, name: str) -> str:
    try:
        found = SimpleCookie(cookies).get(name)
    except CookieError:
        return ""
    return found.value if found else ""


def _sent_token(scope: dict[str, Any], headers: dict[str, str]) -> str:
    """The token of a request, empty without: in a header or, of one that changes nothing (tiles), in the address."""
    sent = headers.get("authorization", "").removeprefix("Bearer ").strip() or headers.get("x-token", "")
    reading = scope["type"] == "websocket" or scope["method"] in _SAFE
    if not sent and reading:
        sent = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
    return sent


_SHOW: Final = "`orthoswarm serve --show-token --workspace DIR` prints"
_TOKEN_MISSING: Final = (401, f"send the daemon's token as the header 'Authorization: Bearer TOKEN'; {_SHOW} it")
_TOKEN_WRONG: Final = (401, f"this is not this daemon's token, each workspace has its own; {_SHOW} the right one")


def _is_same_site(origin: str, host: str, *, encrypted: bool) -> bool:
    """Whether an Origin header names the daemon itself; an unreadable one is foreign, and over TLS a plain one."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in (("https",) if encrypted else ("http", "https")) and parts.netloc.lower() == host.lower()


def _host_name(host: str) -> str:
    try:
        return (urlsplit("//" + host).hostname or "").lower()
    except ValueError:
        return ""


async def _refuse(scope: dict[str, Any], send: Any, status: int, text: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": text[:100]})
        return
    body = json.dumps({"detail": text}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


class TooLarge(OrthoSwarmError):
    """A request is larger than allowed."""


def bounded(receive: Any, most_bytes: int) -> Any:
    """An ASGI receive that raises TooLarge once a body grows beyond a size."""
    size = 0

    async def receiving() -> Any:
        nonlocal size
        message = await receive()
        size += len(message.get("body", b""))
        if size > most_bytes:
            raise TooLarge(f"the request is larger than {most_bytes // 1_000_000} MB; send a smaller picture")
        return message

    return receiving
