"""The console's commands against a real daemon, and the MAVProxy module where MAVProxy is installed."""

import json
import re
import time
import types

import pytest

from gcs_plugin.mavproxy.daemon_client import Client, Commands
from tests.kit.daemon_kit import line, serving
from tests.kit.vehicles.sim_cameras import square


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("w")) as served:
        for shot in line(8):
            served.send(shot)
        served.until("/api/frames", lambda rows: all(row["on_map"] for row in rows))
        yield served


@pytest.fixture
def commands(served):
    return Commands(Client(served.url, served.token))


def test_state_is_told_in_lines(commands):
    assert "1 vehicles, 8 pictures" in commands.run(["status"])[0]
    assert re.fullmatch("v1: .*, sortie 1, 8 pictures.*", commands.run(["vehicles"])[0])
    assert any(text.startswith("realtime: ") and "empty" not in text for text in commands.run(["layers"]))
    assert commands.run(["web"])[0].startswith("http://127.0.0.1:")


@pytest.mark.slow
def test_the_workspace_gives_the_token(served):
    workspace = served.process.args[served.process.args.index("--workspace") + 1]
    commands = Commands(Client(served.url))
    assert "token" in commands.run(["refine"])[0]
    assert "pictures" in commands.run(["connect", workspace])[0]
    assert "refining v1" in commands.run(["refine", "v1"])[0]
    served.until("/api/jobs", lambda rows: all(row["state"] in ("done", "failed") for row in rows))


def test_plans_are_made_and_wrong_words_explained(commands, tmp_path):
    area = tmp_path / "area.geojson"
    area.write_text(json.dumps(square(150)))
    assert "% covered" in commands.run(["plan", str(area), "2", "60", "65"])[0]
    assert "links" in commands.run(["upload", "v1"])[0]
    (plan,) = (row["id"] for row in commands.client.ask("/api/plans"))
    assert "links" in commands.run(["start", plan])[0]
    assert "usage" in commands.run(["plan"])[0]
    assert "usage" in commands.run([])[0]
    assert "usage" in commands.run(["start"])[0]
    assert "no picture" in commands.run(["refine", "nobody"])[0]


def test_a_daemon_that_is_not_there_is_told(tmp_path):
    assert "does not answer" in Commands(Client("http://127.0.0.1:9")).run(["status"])[0]


def mavproxy_state():
    return types.SimpleNamespace(
        command_map={}, completions={}, completion_functions={}, public_modules={}, map_functions={}, multi_instance={},
        instance_count={}, modules=[], aliases={},
    )  # fmt: skip


def said(module, capsys, text, limit_s=240.0):
    """Pass the time as MAVProxy does, until something was printed."""
    end, out = time.monotonic() + limit_s, ""
    while text not in out:
        assert time.monotonic() < end, out
        time.sleep(0.01)
        module.idle_task()
        out += capsys.readouterr().out
    return out


@pytest.mark.parametrize("running", [True, False])
def test_the_mavproxy_module_says_what_runs_and_what_to_type(served, running, monkeypatch, capsys):
    pytest.importorskip("MAVProxy")
    from gcs_plugin import mavproxy
    from gcs_plugin.mavproxy import module as shim

    client = Client(served.url if running else "http://127.0.0.1:9")
    monkeypatch.setattr(shim, "Client", lambda: client)
    state = mavproxy_state()
    module = mavproxy.init(state)
    assert "orthoswarm" in state.command_map
    assert "orthoswarm connect" in said(module, capsys, "a daemon runs at" if running else "no daemon runs at")
    module.typed([])
    assert "serve|feed" in said(module, capsys, "usage: orthoswarm")
    if running:
        module.typed(["connect", served.url, served.token])
        said(module, capsys, "orthoswarm feed")
    else:
        module.typed(["refine"])
        said(module, capsys, "start one with 'orthoswarm serve'")
