"""`orthoswarm serve` ends soon when it is told to, whatever its streams wait for, and leaves everything closed."""

import json
import signal
import socket
import sqlite3
import subprocess
import sys
import time

import httpx
import pytest

from tests.kit.daemon_kit import line, start, stop

SOON_S = 18.0
"""A few seconds, and as many times that as a machine that has others to serve may take before it looks like waiting for
the streams: their time-out is 20 s each, and five that are waited for one after the other take longer."""


@pytest.fixture
def silent_port():
    """Somebody who takes connections and says nothing."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(8)
        yield listener.getsockname()[1]


@pytest.mark.parametrize("told", [signal.SIGINT, signal.SIGTERM])
def test_silent_streams_do_not_hold_it_up(tmp_path, silent_port, told):
    streams = [f"v1=udp://127.0.0.1:{silent_port}", f"v2=tcp://127.0.0.1:{silent_port}"]
    streams += [f"v{n}=rtsp://127.0.0.1:{silent_port}/live" for n in (3, 4, 5)]
    served = start(tmp_path / "w", *(text for stream in streams for text in ("--source", stream)))
    try:
        assert served.send(line(1)[0]).status_code == 201
        time.sleep(1.0)  # all streams are being opened
        began = time.monotonic()
        served.process.send_signal(told)
        assert served.process.wait(60) == 0
        assert time.monotonic() - began < SOON_S
    finally:
        stop(served)
    with sqlite3.connect(tmp_path / "w" / "journal.db") as journal:
        (clean,) = journal.execute("SELECT value FROM meta WHERE key = 'clean'").fetchone()
    journal.close()
    assert json.loads(clean) is True


_LIMIT_S = 120.0
_STARTER = """
import pathlib, sys, time
from gcs_plugin.mavproxy.packet_feed import Child
print(Child(pathlib.Path(sys.argv[1]), ["--port", "0", "--workers", "1"]).url, flush=True)
time.sleep(600)
"""


def test_a_child_ends_when_the_program_that_started_it_is_killed(tmp_path):
    starter = subprocess.Popen([sys.executable, "-c", _STARTER, str(tmp_path / "w")], stdout=subprocess.PIPE, text=True)
    url = starter.stdout.readline().strip()
    assert httpx.get(f"{url}/healthz", trust_env=False, timeout=_LIMIT_S).status_code == 200
    starter.kill()
    starter.wait(_LIMIT_S)
    starter.stdout.close()
    end = time.monotonic() + _LIMIT_S
    with pytest.raises((httpx.NetworkError, httpx.RemoteProtocolError)):  # nobody is there; slow answers do not count
        while time.monotonic() < end:
            httpx.get(f"{url}/healthz", trust_env=False, timeout=_LIMIT_S)
            time.sleep(0.2)
