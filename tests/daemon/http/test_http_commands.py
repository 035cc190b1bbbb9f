"""Commands over HTTP in time and with an outcome, the heartbeat, what pages share, and answers to odd requests."""

import asyncio
import concurrent.futures
import itertools
import json
import math
import os
import re
import signal
import socket
import time
from urllib.parse import urlsplit

import httpx
import pytest

from gcs_plugin.daemon.intake.picture_intake import RefusedPictures
from gcs_plugin.daemon.settings import Settings, VehicleSettings
from gcs_plugin.daemon.store.daemon_events import Events, Told
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from gcs_plugin.web.connections import open_listener
from gcs_plugin.web.event_stream import Standstill
from gcs_plugin.web.uploads import UploadLimits, moving
from orthoswarm.model.errors import InputError
from tests.kit.daemon_kit import GRID, form, line, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.servers.ports import free_port

LIMIT_S = 120.0


@pytest.fixture(scope="module")
def flying(tmp_path_factory):
    """A daemon with two simulated vehicles on its link; v1 is named Falcon."""
    workspace = tmp_path_factory.mktemp("w")
    (workspace / "orthoswarm.toml").write_text('[[vehicle]]\nid = "v1"\nsystem = 1\nname = "Falcon"\n')
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    with SimSwarm(make_swarm(2, home=(lat, lon, 500.0)), "tcpin:127.0.0.1:0", speed=2.0) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(workspace, *links) as served:
            served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
            yield served


def test_a_command_that_was_given_too_long_ago_is_not_executed(flying):
    for given, verb, word in ((time.time() - 6.0, "rtl", "ago"), (time.time() + 60.0, "resume", "from now")):
        answer = flying.command(f"/api/missions/v1/{verb}", {"id": f"late-{word}", "given_s": given})
        assert answer.status_code == 200
        row = answer.json()
        assert (row["id"], row["vehicle"], row["command"]) == (f"late-{word}", "v1", verb)
        assert row["outcome"] == "not_sent" and word in row["reason"]


def test_a_vehicle_whose_id_has_a_slash_gets_its_commands(flying):
    row = flying.command("/api/missions/north%2F1/pause").json()
    assert (row["vehicle"], row["command"], row["outcome"]) == ("north/1", "pause", "not_sent")


@pytest.mark.parametrize("name", ["all", ".", ".."])
def test_an_id_that_no_command_can_address_is_refused_at_the_start(tmp_path, name):
    with pytest.raises(InputError, match=f"cannot have the id '{re.escape(name)}'"):
        Settings(workspace=tmp_path, vehicles=(VehicleSettings(name),)).check()


def listening(flying):
    from websockets.sync.client import connect

    return connect(flying.url.replace("http", "ws") + "/api/events", origin=flying.url, open_timeout=LIMIT_S)


def heartbeat(flying):
    """The daemon's clock that nobody sets, as a page counts on from the heartbeat that it heard, and its run."""
    with listening(flying) as events:
        beat, heard = json.loads(events.recv(timeout=LIMIT_S)), time.monotonic()
    return lambda: beat["clock_s"] + time.monotonic() - heard, beat["run"]


@pytest.mark.parametrize("verb", ["pause", "rtl", "return", "land"])
def test_a_clock_that_was_set_back_keeps_no_urgent_command_from_the_vehicles(flying, verb):
    clock, run = heartbeat(flying)
    for dated in (dict, lambda: {"given_clock_s": clock(), "run": run}):
        # as a page counts on that heard the clock before it was set
        body = {"given_s": time.time() + 30.0} | dated()
        rows = flying.command(f"/api/missions/all/{verb}", body).json()["results"]
        assert {row["outcome"] for row in rows} <= {"done", "refused"}


def test_the_age_of_a_command_counts_by_the_clock_that_nobody_sets(flying):
    clock, run = heartbeat(flying)
    late = {"given_clock_s": clock() - 6.0, "run": run, "given_s": time.time()}
    of_another_run = {"given_clock_s": clock(), "run": "ended"}
    for body in (late, of_another_run):
        row = flying.command("/api/missions/v1/rtl", body).json()
        assert row["outcome"] == "not_sent" and "give it again" in row["reason"]
    fresh = {"given_clock_s": clock(), "run": run, "given_s": time.time() - 60.0}
    assert flying.command("/api/missions/v1/rtl", fresh).json()["outcome"] in ("done", "refused")
    assert flying.command("/api/missions/v1/rtl", {"given_clock_s": "x"}).status_code == 422


def test_a_command_in_time_reaches_the_vehicle_once(flying):
    body = {"id": "once", "given_s": time.time()}
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        rows = list(pool.map(lambda _: flying.command("/api/missions/v1/rtl", body).json(), range(4)))
    assert all(row == rows[0] for row in rows)
    assert rows[0]["outcome"] in ("done", "refused") and rows[0]["reason"]
    other = flying.command("/api/missions/v1/land", body)
    assert other.status_code == 409 and "once" in other.json()["detail"]


@pytest.mark.parametrize("verb", ["pause", "rtl", "return", "land"])
def test_all_vehicles_are_commanded_at_once_with_an_outcome_each(flying, verb):
    answer = flying.command(f"/api/missions/all/{verb}", {"given_s": time.time()}).json()
    assert [row["vehicle"] for row in answer["results"]] == ["v1", "v2"]
    assert {row["outcome"] for row in answer["results"]} <= {"done", "refused"}
    assert {row["id"] for row in answer["results"]} == {answer["id"]}
    assert flying.command("/api/missions/all/upload").status_code == 404
    assert flying.command("/api/missions/v1/return").status_code == 404  # one vehicle has no turn


def test_a_plans_zones_go_into_geofences_and_what_vehicles_hold_can_be_drawn(flying):
    def square(east, north, side):
        corners = [(0, 0), (side, 0), (side, side), (0, side), (0, 0)]
        places = GRID.to_geographic([[EAST + east + x, NORTH + north + y] for x, y in corners])
        return {"type": "Polygon", "coordinates": [[[float(lon), float(lat)] for lat, lon in places]]}

    wanted = {"vehicles": 2, "altitude_m": 80, "fov_min_deg": 70, "area": square(50, 50, 200)}
    plan = flying.command("/api/plans", wanted | {"no_fly": square(120, 120, 40)}).json()
    flying.until("/api/vehicles", lambda rows: all(row["fence"] for row in rows))
    for vehicle in ("v1", "v2"):
        row = flying.command(f"/api/missions/{vehicle}/fence", {"plan": plan["id"]}).json()
        assert (row["command"], row["outcome"]) == ("fence", "done"), row
        assert "holds the geofence: 4 items, read back" in row["reason"]
        body = {"plan": plan["id"], "mission": vehicle}
        assert flying.command(f"/api/missions/{vehicle}/upload", body).json()["outcome"] == "done"
    zones = flying.until("/api/vehicles", lambda rows: all(len(row["fence"]["zones"]) == 1 for row in rows))
    assert {row["fence"]["zones"][0]["kind"] for row in zones} == {"exclusion"}
    routes = {row["vehicle"]: row for row in flying.get("/api/routes").json()}
    assert {row["id"]: row["route"] for row in zones} == {v: routes[v]["route"] for v in ("v1", "v2")}
    planned = flying.get(f"/api/plans/{plan['id']}/map").json()["features"]
    ends = [f["geometry"]["coordinates"][0] for f in planned if f["properties"].get("kind") == "leg"]
    held = [point[1:] for row in routes.values() for point in row["points"]]
    assert ends and all(min(math.dist(end[:2], point) for point in held) < 1e-6 for end in ends)  # degrees: 0.1 m
    assert flying.command("/api/missions/v1/fence", {"plan": "none"}).status_code == 422
    assert flying.command("/api/missions/all/fence", {"plan": plan["id"]}).status_code == 404


@pytest.mark.slow
def test_what_lay_in_a_frozen_daemons_socket_is_not_executed_after_the_thaw(flying):
    """SIGSTOP, an RTL without a time, SIGCONT: nobody can tell how old it is, so the vehicle never gets it."""
    pid = flying.process.pid
    os.kill(pid, signal.SIGSTOP)
    try:
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            given = time.time()
            blind = pool.submit(flying.command, "/api/missions/v1/rtl", {})
            timed = pool.submit(flying.command, "/api/missions/all/land", {"given_s": given})
            time.sleep(7.0)
            os.kill(pid, signal.SIGCONT)
            row, rows = blind.result(LIMIT_S).json(), timed.result(LIMIT_S).json()["results"]
    finally:
        os.kill(pid, signal.SIGCONT)
    assert row["outcome"] == "not_sent" and "give it again" in row["reason"]
    assert {r["outcome"] for r in rows} == {"not_sent"}


def test_a_standstill_is_noticed_before_and_after_the_first_tick():
    now = [0.0]
    watch = Standstill(lambda: now[0])
    assert watch.length_s() == 0.0  # it does not run yet
    for moment in (0.0, 0.25, 0.5):
        now[0] = moment
        watch.tick()
    assert watch.length_s() == 0.0
    now[0] = 36.5
    assert watch.length_s() == 36.0
    watch.tick()
    assert watch.length_s() == 36.0
    now[0] = 36.75
    watch.tick()
    assert watch.length_s() == 36.0
    now[0] = 38.0
    assert watch.length_s() == 0.0


def test_the_event_stream_has_a_heartbeat_with_the_daemons_time(flying):
    beats, before = [], time.time()
    with listening(flying) as events:
        assert before - 0.1 < json.loads(events.recv(timeout=LIMIT_S))["time"] < time.time() + 0.1
        while len(beats) < 3:
            event = json.loads(events.recv(timeout=LIMIT_S))
            if event["type"] == "heartbeat":
                beats.append(event["time"])
    assert beats == sorted(beats)
    assert all(later - one > 0.5 for one, later in itertools.pairwise(beats))


def test_each_vehicle_has_its_id_and_its_name_wherever_it_is_shown(flying):
    assert {r["id"]: r["name"] for r in flying.get("/api/vehicles").json()} == {"v1": "Falcon", "v2": ""}
    named = {}
    with listening(flying) as events:
        while len(named) < 2:
            event = json.loads(events.recv(timeout=LIMIT_S))
            if event["type"] == "vehicle":
                named[event["id"]] = event["name"]
    assert named == {"v1": "Falcon", "v2": ""}


# -- what pages share -------------------------------------------------------------------------------------------------


def put(served, body):
    return httpx.put(f"{served.url}/api/plan", json=body, headers=served.auth, timeout=LIMIT_S)


@pytest.mark.slow
def test_the_plan_is_the_same_for_a_second_page_and_after_a_restart(tmp_path):
    area = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}
    with serving(tmp_path / "w") as served:
        assert served.get("/api/plan").json()["version"] == 0
        one = put(served, {"area": area, "settings": {"altitude_m": 60}, "version": 0})
        assert one.json()["version"] == 1
        late = put(served, {"area": None, "version": 0})
        assert late.status_code == 409 and "elsewhere" in late.json()["detail"]
        assert put(served, {"area": "here"}).status_code == 422
        assert httpx.put(f"{served.url}/api/plan", json={}, timeout=LIMIT_S).status_code == 401
        find = served.command("/api/finds", {"lat_deg": 1.5, "lon_deg": 2, "sigma_m": 0.2, "note": "roof"}).json()
        served.command("/api/finds", {"lat_deg": 1.5, "lon_deg": 2})
        old = {"lat_deg": 1.5, "lon_deg": 2, "time": "2026-05-28T20:26:40Z"}  # one that is put back
        back = served.command("/api/finds", old).json()
        assert back["time"].startswith("2026-05-28T20:26:40")
        assert served.command("/api/finds", old | {"time": "yesterday"}).status_code == 422
        removed = [
            httpx.delete(f"{served.url}/api/finds/{number}", headers=served.auth, timeout=LIMIT_S).status_code
            for number in (back["id"], 2, 2)
        ]
        assert removed == [204, 204, 404]
    with serving(tmp_path / "w") as served:
        plan = served.get("/api/plan").json()
        assert plan["area"] == area and plan["settings"] == {"altitude_m": 60} and plan["version"] == 1
        assert served.get("/api/finds").json() == [find]


def test_a_find_is_changed_by_the_page_that_has_seen_its_last_change(tmp_path):
    def change(number, **fields):
        body = {"lat_deg": 1.5, "lon_deg": 2} | fields
        return httpx.put(f"{served.url}/api/finds/{number}", json=body, headers=served.auth, timeout=LIMIT_S)

    with serving(tmp_path / "w") as served:
        first = served.command("/api/finds", {"lat_deg": 1.5, "lon_deg": 2, "note": "roof"}).json()
        second = served.command("/api/finds", {"lat_deg": 1.5, "lon_deg": 2, "note": "car"}).json()
        assert first["version"] == 1
        changed = change(1, note="two persons", lat_deg=1.6, version=1)
        assert changed.json() == first | {"note": "two persons", "lat_deg": 1.6, "version": 2}
        late = change(1, note="a roof", version=1)
        assert late.status_code == 409 and "elsewhere" in late.json()["detail"]
        assert change(1, lat_deg=100, version=2).status_code == 422
        assert change(9, note="x").status_code == 404
        assert change(1, note="by a program").json()["version"] == 3
        assert httpx.put(f"{served.url}/api/finds/1", json={}, timeout=LIMIT_S).status_code == 401
        assert [row["note"] for row in served.get("/api/finds").json()] == ["by a program", second["note"]]


# -- odd requests -----------------------------------------------------------------------------------------------------


def test_odd_requests_are_answered_in_words(flying):
    assert flying.get("/healthz", headers={"Origin": "http://["}).status_code == 403
    for number in (9223372036854775807, 9223372036854775808, 10**30, -1):
        assert flying.get(f"/api/export/{number}/cog").status_code == 404
    go = "/api/plans/plan-1/start"
    for body in ({"sortie": "x"}, {"sortie": 0}, {"vehicles": [1]}, {"vehicles": {"v1": 5}}, {"override": 3}):
        assert flying.command(go, body).status_code == 422, body
    assert flying.command("/api/missions/%ED%A0%80/rtl").status_code == 200
    for path, body in (("/api/refine", {"vehicle": "\ud800"}), ("/api/export", {"formats": ["\ud800"]})):
        answer = flying.post(path, content=json.dumps(body), headers=flying.auth)
        assert answer.status_code == 422 and answer.json()["detail"]
    for text in (b"NaN", b'{"altitude_m": Infinity}', b"[" * 100_000, b'{"a": 1e999999}', b"9" * 5000):
        assert flying.post("/api/plans", content=text, headers=flying.auth).status_code == 422, text[:20]
    huge = json.dumps({"area": {}, "vehicles": 1, "altitude_m": 10**400})
    assert flying.post("/api/plans", content=huge, headers=flying.auth).status_code == 422
    assert "Traceback" not in "".join(flying.said)


def test_a_missing_and_a_wrong_token_are_told_apart(flying):
    missing = flying.post("/api/refine", json={})
    wrong = flying.post("/api/refine", json={}, headers={"Authorization": "Bearer wrong"})
    assert (missing.status_code, wrong.status_code) == (401, 401)
    assert "send the daemon's token" in missing.json()["detail"]
    assert "not this daemon's token" in wrong.json()["detail"]
    assert all("--show-token" in answer.json()["detail"] for answer in (missing, wrong))


def test_answers_are_sent_at_once():
    listener = open_listener("127.0.0.1", 0)
    listener.listen()
    assert listener.proto == socket.IPPROTO_TCP  # by which asyncio knows to switch Nagle's algorithm off
    listener.close()


# -- uploads ----------------------------------------------------------------------------------------------------------


def half_sent(served, source="127.0.0.1"):
    """An upload whose sender has vanished."""
    parts = urlsplit(served.url)
    connection = socket.create_connection((parts.hostname, parts.port), LIMIT_S, (source, 0))
    head = f"POST /api/frames HTTP/1.1\r\nHost: {parts.netloc}\r\nContent-Length: 100000\r\n"
    head += "Content-Type: multipart/form-data; boundary=x\r\n\r\n--x\r\n"
    connection.sendall(head.encode())
    return connection


@pytest.mark.slow
def test_half_sent_uploads_stop_neither_others_nor_their_own_sender(tmp_path):
    with serving(tmp_path / "w") as served:
        gone = [half_sent(served, "127.0.0.2") for _ in range(300)]
        shot, other = line(2)
        assert served.send(shot).status_code == 201  # another client: at once, though its turn came last
        assert gone[0].recv(1000).startswith(b"HTTP/1.1 408")
        rows = served.until("/healthz", lambda health: health["refused"])["refused"]
        assert rows[0]["cause"] == "time"
        with httpx.Client(transport=httpx.HTTPTransport(local_address="127.0.0.2"), timeout=120) as again:
            assert again.post(f"{served.url}/api/frames", **form(other)).status_code == 201
        for connection in gone:
            connection.close()


def test_an_upload_that_creeps_is_given_up():
    async def creep():
        async def receive():
            await asyncio.sleep(0.02)
            return {"type": "http.request", "body": b"x", "more_body": True}

        receiving = moving(receive, UploadLimits(idle_s=5.0, slow_s=0.1, least_bytes_s=1000.0))
        for count in range(1000):
            try:
                await receiving()
            except TimeoutError:
                return count
        return None

    assert asyncio.run(creep()) is not None


def test_refused_pictures_are_in_health_and_metrics(tmp_path):
    with serving(tmp_path / "w") as served:
        shot = line(1)[0]
        shot.data = b"no picture"
        assert served.send(shot).status_code == 422
        health = served.get("/healthz").json()
        assert [row["cause"] for row in health["refused"]] == ["picture"]
        assert health["refused"][0]["image"] == shot.pose["image"] and "refused" in health["problems"][0]
        metrics = served.get("/metrics").text
        assert 'orthoswarm_pictures_refused_total{cause="picture"} 1' in metrics
        assert 'orthoswarm_pictures_refused_total{cause="disk"} 0' in metrics


def test_a_broken_link_and_two_vehicles_of_one_system_id_are_in_health(tmp_path):
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    port = free_port()
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "orthoswarm.toml").write_text('[[vehicle]]\nid = "north"\nsystem = 1\n')
    ahead = [0.0]

    def clock():
        return time.monotonic() + ahead[0]

    with SimSwarm(make_swarm(1, home=(lat, lon, 500.0)), "tcpin:127.0.0.1:0", clock=clock) as first:
        ahead[0] = 5.0
        links = (first.addresses[0], f"tcp:127.0.0.1:{port}")
        with serving(tmp_path / "w", "--link", links[0], "--link", links[1]) as served:
            broken = f"{links[1]}: no connection (ECONNREFUSED)"
            served.until("/healthz", lambda health: health["problems"] == [broken])
            with SimSwarm(make_swarm(1, home=(lat, lon, 500.0)), f"tcpin:127.0.0.1:{port}"):  # its clock is behind
                shared = served.until("/healthz", lambda health: health["problems"] not in ([], [broken]))["problems"]
    assert len(shared) == 1 and shared[0].startswith("several vehicles use the system id of north: ")
    assert all(link in shared[0] for link in links)


def test_old_refusals_are_counted_but_no_news():
    now, told, events = [0.0], [], Events()
    events.on(Told, told.append)
    refused = RefusedPictures(events, lambda: now[0])
    refused.note("disk", "the disk is full", "v1", "a.jpg")
    refused.note("disk", "the disk is full", "v1", "b.jpg")
    assert refused.problems() == ["2 pictures refused or not on the map: the disk is full"]
    assert [event.told["image"] for event in told] == ["a.jpg", "b.jpg"]
    now[0] = 601.0
    assert refused.problems() == []
    assert refused.counts["disk"] == 2
