"""Readers of camera poses (tags, logs, video metadata, live links), which yield orthoswarm Frames."""

from typing import TYPE_CHECKING

from orthoswarm.model.lazy_names import on_first_use

if TYPE_CHECKING:
    from telemetry.ingest.ingest import LoadOptions, load, survey
    from telemetry.write.tag_writer import with_pose

__all__ = ["LoadOptions", "load", "survey", "with_pose"]

__getattr__ = on_first_use(
    __name__, {"ingest.ingest": ("LoadOptions", "load", "survey"), "write.tag_writer": ("with_pose",)}
)
