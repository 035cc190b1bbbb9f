"""`orthoswarm serve` ends soon when it is told to, whatever its streams wait for, and leaves everything closed."""

import json
import signal
import socket
import sqlite3
import time

import pytest

from tests.kit.daemon_kit import line, start, stop

SOON_S = 12.0
"""A few seconds on a machine that has others to serve, too; the streams' time-out is 20 s each."""


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
