"""Pictures that an earlier run took from a video: listed beside them, and taken again only if something has changed."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from telemetry.video.picture_poses import Poses

_LIST = "pictures.json"
_VERSION = 3


@dataclass(frozen=True, slots=True)
class Kept:
    """One picture in the folder.

    Attributes:
        number: of the picture in the video, in order of presentation.
        packet: index of its packet, None where the decoder did not tell.
        columns: width in pixels; rows: height. damaged: whether it lost parts.
    """

    number: int
    packet: int | None
    columns: int
    rows: int
    damaged: bool = False

    @property
    def name(self) -> str:
        """Its file."""
        return f"{self.number:06d}.jpg"


@dataclass(frozen=True, slots=True)
class Taken:
    """What a whole extraction gave.

    Attributes:
        pictures: those that were taken. seen: pictures decoded. without_pose: left out for lack of a position.
        damaged: pictures that lost parts or could not be decoded.
    """

    pictures: Sequence[Kept]
    seen: int
    without_pose: int
    damaged: int


def key_of(video: Path, poses: Poses, count: int, choice: Sequence[Any]) -> str:
    """What an extraction depends on: the file, how pictures are chosen, and the poses of all `count` packets.

    Raises:
        OSError: the video is gone.
    """
    stat = video.stat()
    digest = hashlib.sha256(f"{_VERSION} {stat.st_size} {stat.st_mtime_ns} {list(choice)!r}".encode())
    for index in range(count):
        digest.update(repr(poses.of(index)).encode())
    return digest.hexdigest()


def recall(folder: Path, key: str) -> Taken | None:
    """What an earlier extraction with this key left in a folder; None if it left nothing whole."""
    try:
        document = json.loads((folder / _LIST).read_text(encoding="utf-8"))
        if document["key"] != key:
            return None
        pictures = [Kept(*row) for row in document["pictures"]]
        taken = Taken(pictures, *(int(document[name]) for name in ("seen", "without_pose", "damaged")))
        return taken if all((folder / kept.name).stat().st_size for kept in pictures) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def remember(folder: Path, key: str, taken: Taken) -> None:
    """List what was taken, once all of it lies in the folder.

    Raises:
        OSError: the folder cannot be written.
    """
    document = {
        "key": key,
        "pictures": [astuple(kept) for kept in taken.pictures],
        "seen": taken.seen,
        "without_pose": taken.without_pose,
        "damaged": taken.damaged,
    }
    temporary = folder / f"{_LIST}.part"
    temporary.write_text(json.dumps(document), encoding="utf-8")
    os.replace(temporary, folder / _LIST)
