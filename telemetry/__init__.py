"""Readers of camera poses (tags, logs, video metadata, live links), which yield orthoswarm Frames."""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from telemetry.ingest.ingest import LoadOptions, load, survey
    from telemetry.write.tag_writer import with_pose

__all__ = ["LoadOptions", "load", "survey", "with_pose"]

_WHERE: Final = {"ingest.ingest": ("LoadOptions", "load", "survey"), "write.tag_writer": ("with_pose",)}


def __getattr__(name: str) -> Any:
    """Import on first use, so that importing the package is fast."""
    for module, names in _WHERE.items():
        if name in names:
            return getattr(import_module(f"telemetry.{module}"), name)
    raise AttributeError(f"module 'telemetry' has no attribute '{name}'")
