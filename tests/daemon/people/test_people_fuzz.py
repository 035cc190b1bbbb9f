"""Random requests to all routes of a command post, by people of all roles and by strangers: no 500, nothing undue done.

ORTHOSWARM_FUZZ is the number of requests (4,000), ORTHOSWARM_FUZZ_SEED their seed.
"""

import asyncio
import os
import random
import time
from collections import Counter
from http.cookies import SimpleCookie

import httpx
import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.people_rows import Role
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from gcs_plugin.web.app import make_app
from gcs_plugin.web.guard import NEEDS, Access, need_of, route_of
from tests.daemon.http.test_http_fuzz import content_of, path_of
from tests.kit.daemon_kit import GRID, Shot, line
from tests.kit.mosaic_scene import EAST, NORTH

COUNT = int(os.environ.get("ORTHOSWARM_FUZZ", "4000"))
SEED = int(os.environ.get("ORTHOSWARM_FUZZ_SEED", "1"))
TOKEN, URL = "a-token-of-tests", "https://127.0.0.1:8650"
SLOW = {"POST /api/plans", "POST /api/areas", "POST /api/export", "POST /api/refine", "POST /api/coverage/flight"}
SLOW_SHARE = 0.1  # of the requests to what takes long: it is fuzzed by itself, too (test_http_fuzz)


class Commanded:
    """Notes each call that sends something to vehicles, with who was at it."""

    def __init__(self, monkeypatch):
        self.by = Counter()
        self.now = None
        for name in ("commands", "upload", "return_in_turn"):
            real = getattr(VehicleLinks, name)

            def call(links, *values, real=real, **more):
                self.by[self.now] += 1
                return real(links, *values, **more)

            monkeypatch.setattr(VehicleLinks, name, call)


async def joined(client, role, number=0):
    made = await client.post("/api/people", json={"name": f"{role.word} {number}", "role": role.word}, headers=auth())
    secret = made.json()["link"].split("#invitation=")[1]
    answer = await client.post("/api/session", json={"invitation": secret})
    client.cookies.clear()
    (cookie,) = SimpleCookie(answer.headers["set-cookie"]).values()
    return {"Cookie": f"{cookie.key}={cookie.value}", "Origin": URL}


def auth():
    return {"Authorization": f"Bearer {TOKEN}"}


def likely(chance, template):
    """The address of a route; half of those of commands are of vehicles and verbs that there are."""
    if chance.random() < 0.5:
        template = template.replace("{vehicle:path}", chance.choice(("v1", "v2", "all")))
        template = template.replace("{verb}", chance.choice(("pause", "resume", "rtl", "land", "upload", "start")))
    return template


def garbled(chance, headers):
    """Credentials that are nobody's."""
    turned = {key: text[::-1] for key, text in headers.items()}
    return chance.choice(
        (turned, {"Cookie": "=;" * 50}, {"Cookie": headers.get("Cookie", "x") + "x"}, {"X-Token": "é"})
    )


@pytest.mark.slow
def test_no_request_ends_in_500_and_no_role_does_what_it_may_not(tmp_path, monkeypatch):
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    with SimSwarm(make_swarm(2, home=(lat, lon, 500.0)), "tcpin:127.0.0.1:0", speed=2.0) as swarm:
        settings = Settings(workspace=tmp_path, lan=True, links=tuple(swarm.addresses))
        with Daemon(settings) as daemon:
            end = time.monotonic() + 60
            while len(daemon.links.heard()) < 2:
                assert time.monotonic() < end
                time.sleep(0.1)
            app = make_app(daemon, Access(TOKEN, "0.0.0.0", lan=True), f"{URL}/")
            asyncio.run(fuzz(app, Commanded(monkeypatch), random.Random(SEED)))


async def fuzz(app, commanded, chance):
    routes = [route for route in NEEDS if not route.startswith("WS ")]
    told: Counter[int] = Counter()
    done: Counter[Role] = Counter()
    transport = httpx.ASGITransport(app, raise_app_exceptions=True)
    async with httpx.AsyncClient(transport=transport, base_url=URL, timeout=300) as client:
        people = {role: await joined(client, role) for role in (Role.VIEWER, Role.ANALYST, Role.PILOT)}
        people |= {Role.ANYBODY: {}, Role.OPERATOR: auth()}
        drawn, began = line(2), time.monotonic()
        for number in range(COUNT):
            route = chance.choice(routes)
            if route in SLOW and chance.random() > SLOW_SHARE:
                continue
            method, template = route.split(" ", 1)
            role = chance.choice(list(people))
            headers = dict(people[role])
            if chance.random() < 0.1:
                role, headers = Role.ANYBODY, garbled(chance, headers)
            body = {} if method == "GET" else content_of(chance, [Shot(dict(s.pose), s.data) for s in drawn])
            if "missions" in route and chance.random() < 0.5:
                body = {"json": {}}
            path = path_of(chance, likely(chance, template))
            encoded = {key.encode(): text.encode("latin-1", "replace") for key, text in headers.items()}
            try:
                request = client.build_request(method, path, headers=encoded, **body)
            except httpx.InvalidURL:
                continue
            commanded.now = role
            answer = await client.send(request)
            told[answer.status_code] += 1
            where = (SEED, number, role, method, path[:200], answer.status_code, answer.text[:300])
            assert answer.status_code != 500, where
            need = need_of(route_of(method, request.url.path))
            if role < need.role:
                assert answer.status_code in (401, 403), where
            else:
                done[role] += 1
            client.cookies.clear()
            if role is Role.OPERATOR and route.startswith("DELETE /api/people"):  # somebody was revoked, perhaps
                for one in (Role.VIEWER, Role.ANALYST, Role.PILOT):
                    answer = await client.get("/api/me", headers=people[one])
                    if answer.json()["role"] is None:
                        people[one] = await joined(client, one, number + 1)
        print(sum(told.values()), "requests in", round(time.monotonic() - began), "s:", dict(told))
        print("let in:", {role.word: n for role, n in done.items()}, "commands:", dict(commanded.by))
    assert set(commanded.by) <= {Role.PILOT, Role.OPERATOR} and all(done.values())
    assert COUNT < 4000 or len(commanded.by) == 2
