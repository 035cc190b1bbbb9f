"""Frames from the journal."""

import json
import sqlite3

from gcs_plugin.daemon.intake.posted_pose import frame_of
from gcs_plugin.daemon.store.journal import unpacked
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.model.frame import Frame


def frame_of_row(row: sqlite3.Row, store: PictureStore) -> Frame:
    """The frame of a journal's row."""
    return frame_of(
        json.loads(row["pose"]), image=unpacked(row["image"]), path=store.path(row["path"]),
        vehicle=unpacked(row["vehicle"]), time_s=row["time"], size=(row["width"], row["height"]),
    )  # fmt: skip
