"""MAVProxy's packets to a daemon and back: what an output of MAVProxy does, without the user having to add one.

The daemon listens on a UDP link (`orthoswarm serve --link udpin:127.0.0.1:14551`). Every packet that MAVProxy hands to
its modules goes there as it came; what the daemon says goes to the link on which its addressee is heard.
"""

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from gcs_plugin.links.packets import Framer
from gcs_plugin.mavproxy.daemon_client import Client

_BUFFER: Final = 1 << 20  # bytes
_START_S: Final = 120.0
_END_S: Final = 60.0


class Feed:
    """Passes packets between MAVProxy's links, whose main loop reads the socket, and a daemon whose link listens there.

    Attributes:
        down: packets to the daemon. up: packets to vehicles.
    """

    def __init__(self, mpstate: Any, host: str, port: int) -> None:
        self._mpstate, self._to = mpstate, (host, port)
        self._framer = Framer()
        self.down = self.up = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.bind(("127.0.0.1" if host in ("127.0.0.1", "localhost") else "0.0.0.0", 0))
        self._socket.setblocking(False)
        mpstate.select_extra[self._socket.fileno()] = (self._read, None)

    def packet(self, message: Any) -> None:
        """Pass a message of a vehicle on, byte for byte."""
        raw = bytes(message.get_msgbuf() or b"")
        if raw:
            with contextlib.suppress(OSError):  # nobody listens there at present
                self._socket.sendto(raw, self._to)
                self.down += 1

    def close(self) -> None:
        """Stop."""
        self._mpstate.select_extra.pop(self._socket.fileno(), None)
        self._socket.close()

    def _read(self, _: Any) -> None:
        """Take what the daemon has said."""
        while True:
            try:
                data, _peer = self._socket.recvfrom(65536)
            except BlockingIOError:
                return
            except OSError:  # the answer to something sent to a port where nobody listens
                continue
            for packet in self._framer.feed(data):
                self._send(int(getattr(packet.message, "target_system", 0)), packet.raw)

    def _send(self, system: int, raw: bytes) -> None:
        """Send to the links on which a system is heard; to all links for 0."""
        for number, heard in list(self._mpstate.vehicle_link_map.items()):
            if system == 0 or any(other == system for other, _ in heard):
                self._mpstate.mav_master[number].write(raw)
                self.up += 1


class Child:
    """A daemon that was started from the console and ends with it, however the console ends (`--end-with-input`).

    Attributes:
        url: of its page. token: what commands need. port: of its link.

    Raises:
        RuntimeError: it did not start, with its own words.
    """

    def __init__(self, workspace: Path, flags: Sequence[str] = ()) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        link = f"udpin:127.0.0.1:{self.port}"
        command = [
            sys.executable, "-m", "gcs_plugin.cli", "serve", "--workspace", str(workspace), "--link", link,
            "--end-with-input", *flags
        ]  # fmt: skip
        workspace.mkdir(parents=True, exist_ok=True)
        self._log = (workspace / "serve.log").open("ab")
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, start_new_session=True
        )
        self.url = self._address(workspace)
        self._wait_until_it_answers(workspace)
        self.token = (workspace / "token").read_text(encoding="utf-8").strip()

    @property
    def running(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def close(self, wait_s: float = 3.0) -> None:
        """End it as Ctrl-C does; what is under way goes on at the next start.

        MAVProxy stands still meanwhile, so after `wait_s` it ends by itself.
        """
        if self.running:
            self._process.terminate()
        ending = threading.Thread(target=self._end, name="daemon's end", daemon=True)
        ending.start()
        ending.join(wait_s)

    def _end(self) -> None:
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._log.close()

    def _address(self, workspace: Path) -> str:
        """The page's address, from its first line."""
        assert self._process.stdout is not None
        end = time.monotonic() + _START_S
        for line in self._process.stdout:
            text = line.decode(errors="replace")
            if text.startswith("map: "):
                threading.Thread(target=self._drain, daemon=True).start()
                return text.split()[1].partition("#")[0].rstrip("/")
            if time.monotonic() > end:
                break
        raise self._failed(workspace)

    def _drain(self) -> None:
        with contextlib.suppress(OSError, ValueError):  # closed at the end
            while self._process.stdout is not None and self._process.stdout.read(4096):
                pass

    def _wait_until_it_answers(self, workspace: Path) -> None:
        client, end = Client(self.url), time.monotonic() + _START_S
        while True:
            try:
                client.ask("/healthz")
                return
            except RuntimeError:
                if not self.running or time.monotonic() > end:
                    raise self._failed(workspace) from None
            time.sleep(0.1)

    def _failed(self, workspace: Path) -> RuntimeError:
        """End it; gives its last words."""
        self.close(_END_S)
        last = (workspace / "serve.log").read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
        return RuntimeError(f"the daemon did not start: {last[0] if last else 'it said nothing'}")
