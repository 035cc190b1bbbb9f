"""Random requests to every route of the HTTP API of a real daemon: none may end in 500, and memory stays flat.

ORTHOSWARM_FUZZ is the number of requests (3,000), ORTHOSWARM_FUZZ_S ends them after so many seconds,
ORTHOSWARM_FUZZ_SEED is their seed.
"""

import contextlib
import json
import os
import random
import re
import time
from urllib.parse import quote_from_bytes

import httpx
import pytest

from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, Shot, form, line, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.vehicles.sim_cameras import square

COUNT = int(os.environ.get("ORTHOSWARM_FUZZ", "3000"))
LIMIT_S = float(os.environ.get("ORTHOSWARM_FUZZ_S", "inf"))
SEED = int(os.environ.get("ORTHOSWARM_FUZZ_SEED", "1"))
STEP = min(500, COUNT // 4)
MOST_GROWTH_MB = 120.0  # modules that a route loads when it is first met take up to 70

NUMBERS = (0, -1, 1, 2, 255, 2**31, 2**63 - 1, 2**63, 10**30, 10**400, 0.5, -1e308, 1e-308, True)
WORDS = (
    "v1", "v2", "all", "plan-1", "rtl", "upload", "realtime", "best", "cog", "odm", "", " ", ".", "..", "../..", "%",
    "\0", "\ud800", "naïve ☃", "a" * 3000, "'; DROP TABLE jobs; --", "[",
    "{}", "null", "NaN", "1e999", "-0", "0x10", "१",
)  # fmt: skip
KEYS = (
    "vehicle", "vehicles", "plan", "mission", "text", "id", "given_s", "sortie", "override", "formats", "area",
    "altitude_m", "fov_min_deg", "speed_m_s", "endurance_min",
    "side_overlap", "forward_overlap", "separation_m", "clearance_m",
    "method", "autopilot", "end", "starts", "settings", "version",
    "wait_min", "wind_m_s", "wind_from_deg", "relief", "height_tolerance_m", "terrain_items", "in_air",
    "heading", "cross", "gimbal_pitch_deg",
    "fly_not_arrived", "lat_deg", "lon_deg", "sigma_m", "note", "image", "time",
    "height_m", "yaw_deg", "pitch_deg", "roll_deg", "gps_fix", "type", "coordinates", "geometry", "features",
)  # fmt: skip
HEADERS = (
    ("Origin", "http://["), ("Origin", "null"), ("Host", "["), ("Content-Type", "multipart/form-data"),
    ("X-Token", "é"),
    ("Content-Type", "multipart/form-data; boundary="), ("Content-Type", "text/plain; charset=\xff"),
    ("Range", "bytes=9-1"),
    ("If-None-Match", '"'), ("Authorization", "Bearer"), ("Content-Type", "application/x-www-form-urlencoded"),
)  # fmt: skip


def value(chance: random.Random, depth=0):
    """Any JSON value."""
    kind = chance.randrange(8 if depth < 4 else 5)
    if kind < 2:
        return chance.choice(NUMBERS)
    if kind < 4:
        return chance.choice(WORDS)
    if kind == 4:
        return chance.choice((None, False, square(150), [[1, 2], [3, 4]], "plan-00000000"))
    if kind == 5:
        return [value(chance, depth + 1) for _ in range(chance.randrange(4))]
    return {key: value(chance, depth + 1) for key in chance.sample(KEYS, chance.randrange(7))}


def path_of(chance: random.Random, template: str) -> str:
    """An address of a route, its parameters filled in with likely and unlikely texts."""

    def fill(_):
        text = chance.choice((*WORDS, *map(str, NUMBERS[:8])))
        return quote_from_bytes(text.encode("utf-8", "surrogatepass"), safe="")

    path = re.sub(r"\{[^}]*\}", fill, template)
    if chance.random() < 0.3:
        pairs = [f"{chance.choice(('vehicle', 'since', 'limit', 'token'))}={fill(None)}" for _ in range(2)]
        path += "?" + "&".join(pairs)
    return path


def content_of(chance: random.Random, shots) -> dict:
    """A request's body: JSON, a posted picture, or bytes."""
    kind = chance.randrange(6)
    if kind < 3:
        known = {key: value(chance, 2) for key in chance.sample(KEYS, chance.randrange(10))}
        return {"content": json.dumps(known).encode()}
    if kind == 3:
        shot = chance.choice(shots)
        shot.pose = {**shot.pose, **{key: value(chance, 3) for key in chance.sample(KEYS, chance.randrange(3))}}
        return form(shot)
    if kind == 4:
        return {"content": json.dumps(value(chance)).encode()}
    return {"content": chance.choice((b"", b"[" * 9999, b"\xff\xfe", b"NaN", b'{"a":1e999}', chance.randbytes(300)))}


def resident_mb(client) -> float:
    found = re.search(r"^orthoswarm_resident_megabytes (\S+)", client.get("/metrics").text, re.M)
    assert found is not None
    return float(found[1])


@pytest.mark.slow
def test_no_request_ends_in_500_and_memory_stays_flat(tmp_path):
    chance = random.Random(SEED)
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    with SimSwarm(make_swarm(2, home=(lat, lon, 500.0)), "tcpin:127.0.0.1:0", speed=2.0) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(tmp_path / "w", *links) as served, contextlib.ExitStack() as at_end:
            client = at_end.enter_context(httpx.Client(base_url=served.url, timeout=300, trust_env=False))
            routes = [
                (method.upper(), path)
                for path, methods in client.get("/openapi.json").json()["paths"].items()
                for method in methods
            ]
            assert len(routes) > 20
            drawn = line(2)
            asked, sizes, began = dict.fromkeys(routes, 0), [], time.monotonic()
            for number in range(COUNT):
                if number % STEP == STEP // 2:
                    sizes.append(resident_mb(client))
                    print(number, sizes[-1], flush=True)
                if time.monotonic() - began > LIMIT_S:
                    break
                method, template = route = chance.choice(routes)
                headers = dict(served.auth if chance.random() < 0.8 else {})
                if chance.random() < 0.15:
                    headers.update([chance.choice(HEADERS)])
                body = (
                    {}
                    if method in ("GET", "HEAD")
                    else content_of(chance, [Shot(dict(shot.pose), shot.data) for shot in drawn])
                )
                path = path_of(chance, template)
                try:
                    encoded = {k.encode(): v.encode("latin-1") for k, v in headers.items()}
                    answer = client.request(method, path, headers=encoded, **body)
                except (httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError, httpx.InvalidURL):
                    continue  # refused below HTTP, or no address that the client sends
                asked[route] += 1
                assert answer.status_code != 500, (SEED, number, method, path[:200], answer.text[:300])
            assert all(asked.values()), asked
            assert client.get("/healthz").status_code == 200
            assert "Traceback" not in "".join(served.said), "".join(served.said)[-3000:]
            print(sum(asked.values()), "requests, resident megabytes", sizes)
            assert sizes[-1] - sizes[len(sizes) // 2] < MOST_GROWTH_MB, (
                sizes
            )  # by then each route has loaded its modules
