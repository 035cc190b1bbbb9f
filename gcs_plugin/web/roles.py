"""The one table of routes: the role that each needs, and the word by which the log of who did what names it.

The guard reads it before a request reaches its route. What is not in it needs the operator's token, except to read.
"""

from typing import Final, NamedTuple

from starlette.routing import compile_path

from gcs_plugin.daemon.store.people_rows import Role


class Need(NamedTuple):
    """What a route needs: a role; `action`: its word in the log, empty for what is not noted."""

    role: Role
    action: str = ""


_READ: Final = Need(Role.VIEWER)
_OPEN: Final = Need(Role.ANYBODY)
EDIT_PLAN: Final = "edit plan"

NEEDS: Final[dict[str, Need]] = {
    "GET /": _OPEN,
    "GET /favicon.ico": _OPEN,
    "GET /healthz": _OPEN,
    "GET /static/{path:path}": _OPEN,
    "GET /api/me": _OPEN,
    "POST /api/session": _OPEN,
    # reading
    "GET /docs": _READ,
    "GET /openapi.json": _READ,
    "GET /metrics": _READ,
    "GET /tiles/{layer}/{z}/{x}/{y}.{suffix}": _READ,
    "GET /api/vehicles": _READ,
    "GET /api/layers": _READ,
    "GET /api/jobs": _READ,
    "GET /api/legs": _READ,
    "GET /api/completions": _READ,
    "GET /api/frames": _READ,
    "GET /api/frames/{seq}/picture": _READ,
    "GET /api/frames/{seq}/view": _READ,
    "GET /api/plans": _READ,
    "GET /api/plans/{number}/map": _READ,
    "GET /api/plan": _READ,
    "GET /api/traffic": _READ,
    "GET /api/finds": _READ,
    "GET /api/finds/{number}/pictures": _READ,
    "GET /api/places": _READ,
    "GET /api/coverage": _READ,
    "GET /api/coverage/gaps.geojson": _READ,
    "GET /api/coverage/cells.png": _READ,
    "GET /api/coverage/vehicles": _READ,
    "GET /api/export/{job}/{kind}": _READ,
    "GET /api/holds": _READ,
    "GET /api/log": _READ,
    "WS /api/events": _READ,
    # areas, plans, finds, the map
    "POST /api/frames": Need(Role.ANALYST),
    "POST /api/areas": Need(Role.ANALYST),
    "POST /api/plans": Need(Role.ANALYST, "plan"),
    "PUT /api/plan": Need(Role.ANALYST, EDIT_PLAN),
    "POST /api/coverage/flight": Need(Role.ANALYST, "plan gaps"),
    "POST /api/finds": Need(Role.ANALYST, "find"),
    "PUT /api/finds/{number}": Need(Role.ANALYST, "change find"),
    "DELETE /api/finds/{number}": Need(Role.ANALYST, "remove find"),
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
"""Method and path of each route, the most particular first where two fit -> what it needs."""

LOCAL_PROGRAMS: Final = frozenset({"POST /api/frames", "POST /api/areas"})
"""What programs of this machine may send without the token: pictures, and area files to be read."""

_READING: Final = frozenset({"HEAD", "OPTIONS"})
_PATTERNS: Final = [(name, name.split(" ", 1)[0], compile_path(name.split(" ", 1)[1])[0]) for name in NEEDS]


def route_of(method: str, path: str) -> str:
    """The row of the table for a request ("GET /api/jobs"), or the request itself if it has none."""
    method = "GET" if method in _READING else method
    exact = f"{method} {path}"
    if exact in NEEDS:
        return exact
    return next((name for name, verb, pattern in _PATTERNS if verb == method and pattern.match(path)), exact)


def need_of(route: str) -> Need:
    """What a route of `route_of` needs; of one that is not in the table the most."""
    return NEEDS.get(route) or Need(Role.VIEWER if route.startswith("GET ") else Role.OPERATOR)
