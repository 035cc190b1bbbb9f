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


EDIT_PLAN: Final = "edit plan"
_OPEN: Final = "/ /favicon.ico /healthz /static/{path:path} /api/me"
_READING: Final = """
    /docs /openapi.json /metrics /tiles/{layer}/{z}/{x}/{y}.{suffix} /tiles/{layer}.json /wmts
    /api/vehicles /api/layers /api/jobs /api/legs
    /api/completions /api/frames /api/routes /api/frames/{seq}/picture /api/frames/{seq}/view /api/plans
    /api/plans/{number}/map /api/plans/{number}/files/{drone} /api/plan /api/traffic /api/finds
    /api/finds/{number}/pictures /api/places /api/trust /api/trust.png /api/change /api/change.png
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
