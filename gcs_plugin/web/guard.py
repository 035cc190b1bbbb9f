"""Access control: same-origin pages and local programs; commands, and all requests of other machines, need the token.

A page of another site cannot reach the daemon: a foreign Origin is refused (cross-site requests), and so is a Host
that is not the daemon's address (DNS rebinding). Commands need the token in a header, which no foreign form can set.
"""

import hmac
import os
import secrets
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from orthoswarm.model.errors import InputError, OrthoSwarmError

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})
_OPEN: Final = frozenset({"/healthz", "/", "/favicon.ico"})
_OPEN_FOLDERS: Final = ("/static/",)
_WITHOUT_TOKEN: Final = frozenset({"/api/frames", "/api/areas"})
"""What local programs may send without the token: pictures, and area files to be read."""
_SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_HEADERS: Final = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' blob: data:; worker-src 'self' blob:; style-src 'self' 'unsafe-inline';"
        b" connect-src 'self'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'",
    ),
]


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
        part = path.with_name(f".{path.name}.part")
        part.unlink(missing_ok=True)
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(token + "\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the token file {path} cannot be used ({error}); name another with --token-file") from None
    return token


class Guard:
    """ASGI middleware that passes requests on or refuses them.

    Args:
        app: the application.
        token: required for commands.
        bind: the address that is served; if it is not a loopback address, all requests need the token.
    """

    def __init__(self, app: Any, token: str, bind: str = "127.0.0.1") -> None:
        self.app, self._token = app, token
        self.local = bind.strip("[]") in LOOPBACK
        self._hosts = LOOPBACK | {bind.strip("[]").lower()}

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """Handle one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers: dict[str, str] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), value.decode("latin-1"))
        refusal = self._refusal(scope, headers)
        if refusal is None:
            await self.app(scope, receive, _with_headers(send) if scope["type"] == "http" else send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal[1][:100]})
        else:
            await _answer(send, *refusal)

    def _refusal(self, scope: dict[str, Any], headers: dict[str, str]) -> tuple[int, str] | None:
        host = headers.get("host", "")
        if self.local and _host_name(host) not in self._hosts:
            return 403, "the Host header does not name this daemon; use the address that it printed"
        origin = headers.get("origin")
        if origin is not None and not _is_same_site(origin, host):
            return 403, "pages of other sites may not use this daemon; open its own page"
        path = scope["path"]
        if not self.local and path not in _OPEN and not path.startswith(_OPEN_FOLDERS):
            return self._token_refusal(scope, headers, query=True)
        unsafe = scope["type"] == "http" and scope["method"] not in _SAFE
        if unsafe and path not in _WITHOUT_TOKEN:
            return self._token_refusal(scope, headers, query=False)
        return None

    def _token_refusal(self, scope: dict[str, Any], headers: dict[str, str], *, query: bool) -> tuple[int, str] | None:
        """HTTP status and reason if a request's token is missing or wrong, else None.

        It comes in a header or, with `query` and for requests that change nothing (tiles, events), in the address.
        """
        sent = headers.get("authorization", "").removeprefix("Bearer ").strip() or headers.get("x-token", "")
        reading = scope["type"] == "websocket" or scope["method"] in _SAFE
        if not sent and query and reading:
            sent = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        if not sent:
            return _TOKEN_MISSING
        # latin-1 is what headers are decoded by; a token is ASCII
        return None if hmac.compare_digest(sent.encode("utf-8", "replace"), self._token.encode()) else _TOKEN_WRONG


_SHOW: Final = "`orthoswarm serve --show-token --workspace DIR` prints"
_TOKEN_MISSING: Final = (401, f"send the daemon's token as the header 'Authorization: Bearer TOKEN'; {_SHOW} it")
_TOKEN_WRONG: Final = (401, f"this is not this daemon's token, each workspace has its own; {_SHOW} the right one")


def _is_same_site(origin: str, host: str) -> bool:
    """Whether an Origin header names the daemon itself; an unreadable one is foreign."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


def _host_name(host: str) -> str:
    try:
        return (urlsplit("//" + host).hostname or "").lower()
    except ValueError:
        return ""


def _with_headers(send: Any) -> Any:
    async def sending(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", []), *_HEADERS]}
        await send(message)

    return sending


async def _answer(send: Any, status: int, text: str) -> None:
    import json

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
