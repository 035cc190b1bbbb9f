"""OrthoSwarm in MAVProxy: `module load gcs_plugin.mavproxy`, a thin shim over a daemon."""

from typing import Any


def init(mpstate: Any) -> Any:
    """The module that MAVProxy loads; MAVProxy is imported only here, so that the client of a daemon needs none."""
    from gcs_plugin.mavproxy.module import OrthoSwarmModule

    return OrthoSwarmModule(mpstate)
