"""OrthoSwarm in MAVProxy: `module load gcs_plugin.mavproxy`, a thin shim over a daemon.

    orthoswarm serve WORKSPACE [FLAGS]     start a daemon that ends with MAVProxy, and feed it
    orthoswarm connect WORKSPACE           or use one that runs (`orthoswarm serve --link udpin:127.0.0.1:14551`),
    orthoswarm feed 127.0.0.1:14551        and feed it

What runs, and what to type next, is said when the module is loaded. MAVProxy holds the links. Commands go to the daemon
over HTTP, in a thread: an upload needs MAVProxy's main loop to pass packets meanwhile, and a fault here never touches
the console's own work.
"""

import queue
import shlex
import threading
import time
from pathlib import Path
from typing import Any, Final

from MAVProxy.modules.lib import mp_module

from gcs_plugin.mavproxy.daemon_client import Client, Commands
from gcs_plugin.mavproxy.packet_feed import Child, Feed

_VERBS: Final = (
    "<status|vehicles|plan|upload|start|pause|resume|rtl|return|land|refine|layers|export|web|connect|serve|feed>"
)
_START_ONE: Final = (
    "'orthoswarm serve WORKSPACE [--basemap MAP]' starts one and feeds it, 'orthoswarm connect URL TOKEN' takes another"
)
_FEED_IT: Final = (
    "vehicles' packets do not go to it yet: 'orthoswarm feed 127.0.0.1:PORT', where it has --link udpin:127.0.0.1:PORT"
)
_DRAW_S: Final = 3.0
_NEWS_S: Final = 1.0


class OrthoSwarmModule(mp_module.MPModule):  # type: ignore[misc]
    """The module as MAVProxy sees it."""

    def __init__(self, mpstate: Any) -> None:
        # named as it is loaded: `module unload` and `module reload` take that name, and a second load is refused
        super().__init__(mpstate, __package__, "map disaster areas with a swarm", public=True, multi_vehicle=True)
        self.commands = Commands(Client())
        self.feed: Feed | None = None
        self.child: Child | None = None
        self._typed: queue.SimpleQueue[list[str] | None] = queue.SimpleQueue()
        self._drawn, self._look_at = 0, 0.0
        self._drawing: threading.Thread | None = None
        self._picture: Any = None
        self._hello = ""
        self._worker = threading.Thread(target=self._work, name="orthoswarm", daemon=True)
        self._worker.start()
        self._over = threading.Event()
        threading.Thread(target=self._tell, name="orthoswarm news", daemon=True).start()
        self.add_command("orthoswarm", self.typed, "map with a swarm", [_VERBS])

    # -- MAVProxy's hooks, in its main thread -----------------------------------------------------------------------

    def typed(self, args: list[str]) -> None:
        """What the user typed after `orthoswarm`; done in the order in which it was typed."""
        self._typed.put(shlex.split(" ".join(args)) if args else [])

    def mavlink_packet(self, packet: Any) -> None:
        """Pass a packet of a vehicle on."""
        if self.feed is not None:
            self.feed.packet(packet)

    def idle_task(self) -> None:
        """Keep the mosaic on the maps that are open; say what to type once the console is there."""
        if self._hello:
            print(self._hello)
            self._hello = ""
        picture, self._picture = self._picture, None
        if picture is not None:
            for shown in self._maps():
                shown.add_object(picture)
        now = time.monotonic()
        if now >= self._look_at and self._maps() and (self._drawing is None or not self._drawing.is_alive()):
            self._look_at = now + _DRAW_S
            self._drawing = threading.Thread(target=self._look, name="mosaic", daemon=True)
            self._drawing.start()

    def unload(self) -> None:
        """End what was begun."""
        self._typed.put(None)
        self._over.set()
        if self.feed is not None:
            self.feed.close()
            self.feed = None
        if self.child is not None:
            self.child.close()
            self.child = None
        super().unload()

    # -- in threads of our own ---------------------------------------------------------------------------------------

    def _greeting(self) -> str:
        """What runs, and what to type next."""
        client = self.commands.client
        try:
            client.ask("/healthz")
        except RuntimeError:
            return f"orthoswarm: no daemon runs at {client.url}; {_START_ONE}"
        return (
            f"orthoswarm: a daemon runs at {client.url}; 'orthoswarm connect WORKSPACE' lets you command it; {_FEED_IT}"
        )

    def _work(self) -> None:
        self._hello = self._greeting()
        while (words := self._typed.get()) is not None:
            try:
                for line in self._run(words):
                    print(line)
            except (RuntimeError, OSError, ValueError) as error:
                print(f"orthoswarm: {error}")

    def _tell(self) -> None:
        """Say at once what goes wrong: a takeoff that is held, vehicles that come too near each other."""
        while not self._over.wait(_NEWS_S):
            if self.feed is not None or self.commands.client.token:
                for line in self.commands.news():
                    print(f"orthoswarm: {line}")

    def _run(self, words: list[str]) -> list[str]:
        if words[:1] == ["serve"]:
            return self._serve(words[1:])
        if words[:1] == ["feed"]:
            return self._feed(words[1:])
        lines = self.commands.run(words)
        if words[:1] == ["connect"] and self.feed is None and lines and lines[0].startswith("daemon "):
            lines.append(_FEED_IT)
        return [f"{line}|serve|feed" if line.startswith("usage: orthoswarm status") else line for line in lines]

    def _serve(self, words: list[str]) -> list[str]:
        """`serve [WORKSPACE] [FLAGS of orthoswarm serve]`."""
        if self.child is not None and self.child.running:
            return [f"orthoswarm: a daemon runs already: {self.child.url}/"]
        named = bool(words) and not words[0].startswith("-")
        workspace = Path(words[0] if named else "workspace")
        self.child = child = Child(workspace, words[1:] if named else words)
        self.commands.client.url, self.commands.client.token = child.url, child.token
        return [f"the daemon runs: {child.url}/", *self._feed([f"127.0.0.1:{child.port}"])]

    def _feed(self, words: list[str]) -> list[str]:
        """`feed HOST:PORT`: where the daemon's link listens."""
        host, _, port = words[0].rpartition(":") if len(words) == 1 else ("", "", "")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            return ["usage: orthoswarm feed HOST:PORT, where the daemon has --link udpin:HOST:PORT"]
        before, self.feed = self.feed, Feed(self.mpstate, host, int(port))
        if before is not None:
            before.close()
        return [f"vehicles' packets go to {host}:{port}"]

    def _maps(self) -> list[Any]:
        """The maps that are open."""
        modules = [pair[0] for pair in self.mpstate.modules]
        return [m.map for m in modules if hasattr(getattr(m, "map", None), "add_object")]

    def _look(self) -> None:
        """Fetch the mosaic, if it has changed."""
        from gcs_plugin.mavproxy.map_overlay import fetch_mosaic

        try:
            row = next((r for r in self.commands.client.ask("/api/layers") if r["name"] == "best"), None)
            if row is None or row["version"] == self._drawn:
                return
            picture = fetch_mosaic(self.commands.client)
        except RuntimeError:  # the daemon is not there (yet)
            return
        if picture is not None:
            self._drawn, self._picture = picture.version, picture
