"""Live streams over the loopback: TCP-TS, UDP-TS and RTSP carry SEI to its own picture."""

import socket
import subprocess
import sys
import threading
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest

from telemetry.live.live_stream import open_stream
from telemetry.videos.video_file import NotAVideo
from telemetry.write.sei_writer import add_sei
from tests.kit.servers.ports import free_port
from tests.telemetry.videos.test_video import make_video, pose

av = pytest.importorskip("av")


@pytest.fixture(scope="module")
def marked(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("live")
    source = make_video(folder / "s.ts", count=40, b_frames=2)
    add_sei(source, folder / "t.ts", pose)
    return folder / "t.ts"


def check(pictures, least: int) -> None:
    assert len(pictures) >= least
    for picture in pictures:
        number = round((picture.time_s - 1.7e9 - 0.0123456) * 10)
        assert picture.sample == pose(number)
        if not picture.damaged:  # the picture's brightness tells its number
            assert picture.rgb.mean() == pytest.approx(4 * number + 25.5, abs=4.0)


def test_a_stream_over_tcp(marked):
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = server.accept()
        with connection:
            connection.sendall(marked.read_bytes())

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    pictures = list(open_stream(url, all_pictures=True, reconnect=False))
    thread.join()
    server.close()
    check(pictures, 38)


def test_a_lost_link_is_opened_again_until_stopped(marked):
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(0.2)

    def serve() -> None:
        while not stop.is_set():
            with suppress(TimeoutError, ConnectionError):
                connection, _ = server.accept()
                with connection:
                    connection.sendall(marked.read_bytes())

    stop, states, pictures = threading.Event(), [], []
    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    for picture in open_stream(url, every_m=20.0, stop=stop, on_state=states.append):
        pictures.append(picture)
        lat = [p.sample.lat_deg for p in pictures]
        again = any(after < before for before, after in pairwise(lat))  # the same flight once more
        if again and lat[-1] > pose(30).lat_deg:
            stop.set()
    thread.join()
    server.close()
    assert states[:3] == ["open", "lost: the stream ended", "open"]
    assert 8 <= len(pictures) <= 20
    assert len({p.number for p in pictures}) == len(pictures)


def test_a_stream_over_udp(marked):
    data = marked.read_bytes()
    stop = threading.Event()
    port = free_port()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stop.is_set():
                for at in range(0, len(data), 7 * 188):
                    sender.sendto(data[at : at + 7 * 188], ("127.0.0.1", port))
                    if stop.wait(0.002):
                        return

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    pictures = []
    for picture in open_stream(f"udp://127.0.0.1:{port}", all_pictures=True, stop=stop, reconnect=False):
        if picture.sample is not None:
            pictures.append(picture)
        if len(pictures) >= 30:
            stop.set()
    thread.join()
    assert len(pictures) >= 30
    assert all(p.sample == pose(round((p.time_s - 1.7e9 - 0.0123456) * 10)) for p in pictures)


PUSH = """
import sys, time, av
for _ in range(50):
    try:
        with av.open(sys.argv[1]) as source:
            options = {"rtsp_transport": "tcp"}
            with av.open(sys.argv[2], "w", format="rtsp", options=options, timeout=5) as sink:
                stream = sink.add_stream_from_template(source.streams.video[0])
                for packet in source.demux(source.streams.video[0]):
                    if packet.dts is not None:
                        packet.stream = stream
                        sink.mux(packet)
        break
    except (av.error.FFmpegError, OSError):
        time.sleep(0.1)
"""


def test_a_stream_over_rtsp(marked):
    """The camera pushes from a process of its own; the reader plays the server."""
    url = f"rtsp://127.0.0.1:{free_port()}/live"
    camera = subprocess.Popen([sys.executable, "-c", PUSH, str(marked), url])
    try:
        options = {"rtsp_flags": "listen", "listen_timeout": "10"}
        pictures = list(open_stream(url, all_pictures=True, reconnect=False, timeout_s=10.0, options=options))
    finally:
        camera.kill()
        camera.wait()
    check([p for p in pictures if p.sample is not None], 30)


def test_a_file_is_a_stream_too_and_klv_is_interpolated(real_data):
    path = real_data("kwiver_klv") / "aphill_short.ts"
    pictures = list(open_stream(str(path), all_pictures=True, reconnect=False))
    placed = [p for p in pictures if p.sample is not None and p.sample.has_position]
    assert len(placed) >= 40
    assert {p.origin for p in placed} == {"KLV + SEI MISB time"}


def test_nothing_there_is_said_once_or_retried():
    with pytest.raises(NotAVideo):
        list(open_stream("tcp://127.0.0.1:9", reconnect=False, timeout_s=1.0))
    stop, states = threading.Event(), []

    def note(state: str) -> None:
        states.append(state)
        if len(states) == 2:
            stop.set()

    assert list(open_stream("tcp://127.0.0.1:9", stop=stop, timeout_s=1.0, on_state=note)) == []
    assert all(state.startswith("lost") for state in states)
