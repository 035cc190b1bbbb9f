"""Two implementations of the connection to vehicles: our own with pymavlink (the default), and MAVSDK."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from gcs_plugin.backends.backend import Backend, DirectBackend
from gcs_plugin.mission.exchange import GROUND_STATION, Address
from orthoswarm.model.errors import InputError

NAMES = ("pymavlink", "mavsdk")


def open_backend(
    name: str,
    links: Sequence[str],
    *,
    own: Address = GROUND_STATION,
    key: bytes | None = None,
    tlog: Path | None = None,
) -> Backend:
    """Open links (`links.parse_link`) with a backend of NAMES; only pymavlink has a signing key and a telemetry log.

    Raises:
        InputError: an address is wrong, or the backend lacks an option.
    """
    if name == "pymavlink":
        return DirectBackend(links, own=own, key=key, tlog=tlog)
    if name == "mavsdk":
        if find_spec("mavsdk") is None:
            raise InputError("the mavsdk backend needs MAVSDK: pip install 'orthoswarm[mavsdk]'")
        from gcs_plugin.backends.mavsdk import MavsdkBackend

        if key is not None or tlog is not None:
            raise InputError("the mavsdk backend neither signs nor writes a tlog; use --backend pymavlink for that")
        return MavsdkBackend(links, own=own)
    raise InputError(f"there is no backend '{name}'; choose one of: {', '.join(NAMES)}")


__all__ = ["NAMES", "Backend", "open_backend"]
