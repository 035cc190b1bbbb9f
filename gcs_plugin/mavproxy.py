"""OrthoSwarm in MAVProxy: `module load gcs_plugin.mavproxy`, a thin shim over a running daemon.

MAVProxy holds the links; the daemon listens to them on an output of MAVProxy (`output add 127.0.0.1:14551` and
`orthoswarm serve --link udpin:127.0.0.1:14551`). Commands go to the daemon over HTTP, so that a fault here never
touches the console's own work.
"""

import shlex
from typing import Any

from MAVProxy.modules.lib import mp_module

from gcs_plugin.console import Client, Commands


class OrthoSwarmModule(mp_module.MPModule):  # type: ignore[misc]
    """The module as MAVProxy sees it."""

    def __init__(self, mpstate: Any) -> None:
        super().__init__(mpstate, "orthoswarm", "map disaster areas with a swarm", public=True, multi_vehicle=True)
        self.commands = Commands(Client())
        verbs = "<status|vehicles|plan|upload|start|pause|rtl|refine|layers|export|web|connect>"
        self.add_command("orthoswarm", self.typed, "map with a swarm", [verbs])

    def typed(self, args: list[str]) -> None:
        """What the user typed after `orthoswarm`."""
        for line in self.commands.run(shlex.split(" ".join(args)) if args else []):
            print(line)


def init(mpstate: Any) -> OrthoSwarmModule:
    """MAVProxy's way to start a module."""
    return OrthoSwarmModule(mpstate)
