"""Connections without requests: they take nobody's place for long, and never all places."""

import asyncio
import contextlib
import socket
import subprocess
import sys
import threading

import pytest
import uvicorn
from websockets.sync.client import connect

from gcs_plugin.web.connections import ConnectionLimits, Connections, bounded_protocol

_REQUEST_S = 0.4
_LIMIT_S = 60.0


async def application(scope, receive, send):
    """Answers every request, and keeps every event stream open."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        await asyncio.sleep(2 * _REQUEST_S)
        await send({"type": "websocket.send", "text": "still here"})
        return
    await send({"type": "http.response.start", "status": 204, "headers": []})
    await send({"type": "http.response.body", "body": b""})


@contextlib.contextmanager
def served(*, request_s=4 * _LIMIT_S, **limits):
    """The port of a server with these limits; unless said, it waits for requests longer than any test does."""
    protocol = bounded_protocol(Connections(ConnectionLimits(request_s=request_s, **limits)))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        config = uvicorn.Config(application, http=protocol, lifespan="off", log_level="error")
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join(_LIMIT_S)


def opened(port, address="127.0.0.1"):
    return socket.create_connection(("127.0.0.1", port), timeout=_LIMIT_S, source_address=(address, 0))


def is_answered(connection):
    """Whether a request is answered; the server has given up the connection's place then."""
    answer = b""
    try:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
        while part := connection.recv(64):
            answer += part
    except OSError:  # reset
        return False
    return answer.startswith(b"HTTP/1.1 204")


def is_closed(connection):
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def test_one_client_cannot_take_the_places_of_others():
    with served(most=100, share=3) as port:
        idle = [opened(port) for _ in range(3)]
        further = opened(port)
        assert is_closed(further)
        with opened(port, "127.0.0.2") as other:
            assert is_answered(other)
        assert is_answered(idle[0])
        with opened(port) as next_one:  # the place of the one that was answered
            assert is_answered(next_one)
        for connection in (*idle, further):
            connection.close()


def test_there_are_never_more_than_so_many_connections():
    with served(most=4, share=3) as port:
        idle = [opened(port, address) for address in ("127.0.0.1", "127.0.0.2") for _ in range(2)]
        with opened(port, "127.0.0.3") as further:
            assert is_closed(further)
        for connection in idle:
            connection.close()


@pytest.mark.parametrize("head", [b"", b"GET / HTTP/1.1\r\nHost: a\r\n"])
def test_a_connection_without_a_request_is_closed_and_an_event_stream_is_not(head):
    with (
        served(most=9, share=9, request_s=_REQUEST_S) as port,
        opened(port) as silent,
        connect(f"ws://127.0.0.1:{port}/", open_timeout=_LIMIT_S) as events,
    ):
        with contextlib.suppress(ConnectionError):  # it is closed already where the event stream came late
            silent.sendall(head)
        assert is_closed(silent)
        assert events.recv(timeout=_LIMIT_S) == "still here"


def test_few_open_files_leave_room_for_pictures_and_more_are_asked_for():
    pytest.importorskip("resource")
    code = (
        "import resource as r; from gcs_plugin.web.connections import *;"
        "r.setrlimit(r.RLIMIT_NOFILE, (256, {hard}));"
        "files = open_files(); limits = ConnectionLimits.of_files(files);"
        "print(files == r.getrlimit(r.RLIMIT_NOFILE)[0], limits.most + limits.waiting < files, limits.share, files)"
    )
    for hard, expected in ((256, "True True 64 256"), (1024, "True True 256 1024")):
        said = subprocess.run(
            [sys.executable, "-c", code.format(hard=hard)], check=True, capture_output=True, text=True
        ).stdout
        assert said.strip() == expected
