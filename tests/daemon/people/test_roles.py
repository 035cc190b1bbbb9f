"""Each route needs exactly one role; no request with less reaches it, and none of another site does."""

import contextlib
import re
from http.cookies import SimpleCookie

import httpx
import pytest
from starlette.routing import Route, WebSocketRoute

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.people_rows import Role
from gcs_plugin.fleet.commands import VERBS
from gcs_plugin.web.app import STATIC, make_app
from gcs_plugin.web.guard import LOCAL_PROGRAMS, NEEDS, Access, need_of, route_of

TOKEN = "a-token-of-tests"
URL = "https://post.local:8650"
FILLED = {"{layer}": "best", "{suffix}": "webp", "{verb}": "pause", "{kind}": "cog", "{vehicle:path}": "v9"}


@pytest.fixture(scope="module")
def daemon(tmp_path_factory):
    workspace = tmp_path_factory.mktemp("post")
    with contextlib.closing(Daemon(Settings(workspace=workspace))) as daemon:
        yield daemon


@pytest.fixture
def ask(daemon):
    return asking(daemon, Access(TOKEN, "0.0.0.0", lan=True))


def asking(daemon, access, url=URL):
    """A function that sends one request to a daemon's application."""
    app = make_app(daemon, access, f"{url}/")

    async def send(method, path, **options):
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(base_url=url, transport=transport) as client:
            return await client.request(method, path, **options)

    def ask(method, path, **options):
        import asyncio

        return asyncio.run(send(method, path, **options))

    ask.app = app
    return ask


def session(ask, name, role):
    """The headers of somebody's page who was invited."""
    made = ask("POST", "/api/people", json={"name": name, "role": role}, headers=operator())
    assert made.status_code == 201, made.text
    secret = made.json()["link"].split("#invitation=")[1]
    answer = ask("POST", "/api/session", json={"invitation": secret}, headers={"Origin": URL})
    assert answer.status_code == 200, answer.text
    (cookie,) = SimpleCookie(answer.headers["set-cookie"]).values()
    return {"Cookie": f"{cookie.key}={cookie.value}", "Origin": URL}


def operator():
    return {"Authorization": f"Bearer {TOKEN}"}


def path_of(template):
    for name, text in FILLED.items():
        template = template.replace(name, text)
    return re.sub(r"\{[^}]*\}", "1", template)


def routes(app):
    """Method and path of everything that an application answers."""
    for route in app.app.app.routes:  # behind the guard and what compresses
        if isinstance(route, WebSocketRoute):
            yield f"WS {route.path}"
        elif isinstance(route, Route):
            yield from (f"{method} {route.path}" for method in (route.methods or ()) if method != "HEAD")


def test_each_route_has_one_row_and_each_row_a_route(ask):
    answered = set(routes(ask.app)) - {"GET /docs/oauth2-redirect"}
    assert answered == set(NEEDS)
    for route in NEEDS:
        method, template = route.split(" ", 1)
        assert route_of(method, path_of(template)) == route  # no row hides another


def test_what_changes_something_needs_more_than_to_read():
    for route, need in NEEDS.items():
        if not route.startswith(("GET ", "WS ")) and route != "POST /api/session":
            assert need.role >= Role.ANALYST, route
        if "missions" in route or "start" in route or "holds/" in route:
            assert need.role is Role.PILOT, route
    assert need_of(route_of("POST", "/api/new")).role is Role.OPERATOR  # a row that was forgotten
    assert need_of(route_of("GET", "/api/new")).role is Role.VIEWER


def test_no_role_reaches_what_needs_more(ask):
    people = {role: session(ask, f"{role.word} of all", role.word) for role in (Role.VIEWER, Role.ANALYST, Role.PILOT)}
    people |= {Role.ANYBODY: {"Origin": URL}, Role.OPERATOR: operator()}
    for route, need in NEEDS.items():
        method, template = route.split(" ", 1)
        if method == "WS" or route == "POST /api/session":
            continue
        for role, headers in people.items():
            answer = ask(method, path_of(template), headers=headers)
            refused = answer.status_code in (401, 403)
            assert refused == (role < need.role), (route, role, answer.status_code, answer.text)
            if refused and role > Role.ANYBODY:
                assert need.role.word in answer.json()["detail"]


def test_a_session_is_for_the_page_itself_alone(ask):
    pilot = session(ask, "Paula", "pilot")
    cookie = {"Cookie": pilot["Cookie"]}
    command = ("POST", "/api/missions/v1/pause")
    assert ask(*command, headers=pilot).status_code == 409  # there are no links
    for foreign in ("https://evil.example", "http://post.local:8650", "https://post.local:8651", "null"):
        assert ask(*command, headers={**cookie, "Origin": foreign}).status_code == 403
        assert ask("GET", "/api/vehicles", headers={**cookie, "Origin": foreign}).status_code == 403
    assert ask(*command, headers=cookie).status_code == 403  # no browser leaves the Origin out
    assert ask("GET", "/api/vehicles", headers=cookie).status_code == 200
    secret = pilot["Cookie"].split("=", 1)[1]
    assert ask("GET", f"/api/vehicles?token={secret}", headers={}).status_code == 401  # it stands in no address


def test_the_cookie_is_read_by_no_script_and_sent_to_nobody_else(ask):
    made = ask("POST", "/api/people", json={"name": "Cleo", "role": "viewer"}, headers=operator()).json()
    secret = made["link"].split("#invitation=")[1]
    answer = ask("POST", "/api/session", json={"invitation": secret}, headers={"Origin": URL})
    flags = answer.headers["set-cookie"].lower()
    assert flags.startswith("__host-orthoswarm-")
    assert all(flag in flags for flag in ("httponly", "secure", "samesite=strict", "path=/"))
    assert secret not in answer.text and secret not in flags
    rows = [set(row) for row in made["qr"]]
    assert len(rows) == len(made["qr"][0]) >= 21 and all(row <= {"0", "1"} for row in rows)


def test_an_invitation_is_good_once_and_until_it_is_taken_back(ask):
    made = ask("POST", "/api/people", json={"name": "Ida", "role": "pilot"}, headers=operator()).json()
    invitation = {"invitation": made["link"].split("#invitation=")[1]}
    assert ask("POST", "/api/session", json=invitation).status_code == 200
    again = ask("POST", "/api/session", json=invitation)
    assert again.status_code == 403 and "opened already" in again.json()["detail"]
    late = ask("POST", "/api/people", json={"name": "Leo", "role": "pilot"}, headers=operator()).json()
    assert ask("DELETE", f"/api/people/{late['id']}", headers=operator()).status_code == 204
    invitation = {"invitation": late["link"].split("#invitation=")[1]}
    assert ask("POST", "/api/session", json=invitation).status_code == 403


def test_who_is_revoked_is_out_at_once(ask):
    pilot = session(ask, "Rita", "pilot")
    assert ask("GET", "/api/me", headers=pilot).json()["role"] == "pilot"
    (rita,) = (row for row in ask("GET", "/api/people", headers=operator()).json() if row["name"] == "Rita")
    assert rita["state"] == "joined"
    assert ask("DELETE", f"/api/people/{rita['id']}", headers=operator()).status_code == 204
    assert ask("GET", "/api/me", headers=pilot).json()["role"] is None
    assert ask("POST", "/api/missions/v1/pause", headers=pilot).status_code == 401
    assert ask("DELETE", f"/api/people/{rita['id']}", headers=operator()).status_code == 404


@pytest.mark.parametrize(
    "body",
    [
        {"name": "", "role": "pilot"}, {"name": "x" * 61, "role": "pilot"}, {"name": "a\nb", "role": "pilot"},
        {"name": "Max", "role": "operator"}, {"name": "Max", "role": "anybody"}, {"name": "operator", "role": "pilot"},
        {"name": 1, "role": "pilot"}, {"name": "Max"}, {"name": "Max", "role": ["pilot"]}, {},
    ],
)  # fmt: skip
def test_nobody_is_invited_without_name_and_role(ask, body):
    assert ask("POST", "/api/people", json=body, headers=operator()).status_code == 422


def test_two_people_do_not_have_one_name(ask):
    body = {"name": "Twin ☃", "role": "viewer"}
    first = ask("POST", "/api/people", json=body, headers=operator())
    assert ask("POST", "/api/people", json=body, headers=operator()).status_code == 422
    assert ask("DELETE", f"/api/people/{first.json()['id']}", headers=operator()).status_code == 204
    assert ask("POST", "/api/people", json=body, headers=operator()).status_code == 201


def test_where_all_may_read_nobody_may_do_more(daemon):
    ask = asking(daemon, Access(TOKEN, "0.0.0.0", lan=True, open_reading=True))
    assert ask("GET", "/api/vehicles").status_code == 200
    assert ask("GET", "/api/me").json()["role"] == "viewer"
    for route, need in NEEDS.items():
        method, template = route.split(" ", 1)
        if need.role > Role.VIEWER:
            assert ask(method, path_of(template)).status_code == 401, route


def test_on_one_machine_alone_nobody_is_invited_and_programs_send_pictures(daemon):
    ask = asking(daemon, Access(TOKEN), "http://127.0.0.1:8650")
    answer = ask("POST", "/api/people", json={"name": "Ed", "role": "pilot"}, headers=operator())
    assert answer.status_code == 409 and "--lan" in answer.json()["detail"]
    assert ask("POST", "/api/session", json={"invitation": "x"}).status_code == 403
    for route, need in NEEDS.items():
        method, template = route.split(" ", 1)
        if method != "WS":
            refused = ask(method, path_of(template)).status_code == 401
            assert refused == (need.role > Role.VIEWER and route not in LOCAL_PROGRAMS), route


def test_the_journal_has_no_secret(daemon, ask):
    pilot = session(ask, "Sven", "pilot")
    secret = pilot["Cookie"].split("=", 1)[1].encode()
    files = list(daemon.settings.workspace.glob("journal.db*"))
    assert files and not any(secret in file.read_bytes() for file in files)


def test_what_was_done_is_noted_with_name_role_and_outcome(daemon, ask):
    analyst = session(ask, "=Anna", "analyst")
    find = {"lat_deg": 48.0, "lon_deg": 11.0, "note": "boat"}
    number = ask("POST", "/api/finds", json=find, headers=analyst).json()["id"]
    assert ask("POST", "/api/finds", json={}, headers=analyst).status_code == 422
    for _ in range(5):  # a drawing saves itself again and again
        assert ask("PUT", "/api/plan", json={"settings": {}}, headers=analyst).status_code == 200
    assert ask("DELETE", f"/api/finds/{number}", headers=analyst).status_code == 204
    daemon.journal.remember("written", True)  # what was submitted before is written now
    rows = [row for row in ask("GET", "/api/log", headers=analyst).json() if row["name"] == "=Anna"]
    told = [(row["action"], row["target"], row["outcome"], row["count"]) for row in reversed(rows)]
    assert told == [
        ("join", "", "done", 1), ("find", "", "done", 1), ("find", "", "refused", 1), ("edit plan", "", "done", 5),
        ("remove find", str(number), "done", 1),
    ]  # fmt: skip
    assert "lat_deg" in rows[2]["reason"] and {row["role"] for row in rows} == {"analyst"}
    lines = daemon.people.table().splitlines()
    assert lines[0].startswith("time,name,role") and "'=Anna,analyst,remove find" in lines[-1]


def test_every_word_of_the_log_is_in_the_catalogue():
    words = (STATIC / "people" / "words.js").read_text(encoding="utf-8")
    noted = {need.action for need in NEEDS.values() if need.action} | {*VERBS, "upload", "fence", "return", "take"}
    assert {action for action in noted if words.count(f'"log.act.{action}"') != 2} == set()
