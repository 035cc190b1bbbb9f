"""Readers of camera poses (tags, logs, video metadata, live links), which yield orthoswarm Frames."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from telemetry.ingest.ingest import LoadOptions, load

__all__ = ["LoadOptions", "load"]


def __getattr__(name: str) -> Any:
    """Import the readers on first use, so that importing the package is fast."""
    if name in __all__:
        from telemetry.ingest import ingest

        return getattr(ingest, name)
    raise AttributeError(f"module 'telemetry' has no attribute '{name}'")
