"""Cache of pictures extracted from a video: a list in their folder, valid until something changes."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from telemetry.videos.picture_poses import Poses

_LIST = "pictures.json"
_VERSION = 5


@dataclass(frozen=True, slots=True)
class CachedPicture:
    """One picture in the cache folder.

    Attributes:
        number: of the picture in the video, in order of presentation.
        packet: index of its packet, None if the decoder did not report it.
        columns: width in pixels; rows: height. damaged: whether it lost parts.
    """

    number: int
    packet: int | None
    columns: int
    rows: int
    damaged: bool = False

    @property
    def name(self) -> str:
        """Its file name."""
        return f"{self.number:06d}.jpg"


@dataclass(frozen=True, slots=True)
class CachedExtraction:
    """The list of a complete extraction.

    Attributes:
        pictures: the extracted ones. seen: number decoded. without_pose: number left out for lack of a position.
        on_ground: number left out because they were taken on the ground.
        damaged: number that lost parts or could not be decoded.
    """

    pictures: Sequence[CachedPicture]
    seen: int
    without_pose: int
    on_ground: int
    damaged: int


def key_of(video: Path, poses: Poses, count: int, choice: Sequence[Any]) -> str:
    """Cache key of an extraction: the file, the selection of pictures, and the poses of all `count` packets.

    Raises:
        OSError: the video does not exist any more.
    """
    stat = video.stat()
    digest = hashlib.sha256(f"{_VERSION} {stat.st_size} {stat.st_mtime_ns} {list(choice)!r}".encode())
    for index in range(count):
        digest.update(repr(poses.of(index)).encode())
    return digest.hexdigest()


def recall(folder: Path, key: str) -> CachedExtraction | None:
    """The list of an earlier extraction with this key; None if there is none or it is incomplete."""
    try:
        document = json.loads((folder / _LIST).read_text(encoding="utf-8"))
        if document["key"] != key:
            return None
        pictures = [CachedPicture(*row) for row in document["pictures"]]
        extraction = CachedExtraction(
            pictures, *(int(document[name]) for name in ("seen", "without_pose", "on_ground", "damaged"))
        )
        return extraction if all((folder / picture.name).stat().st_size for picture in pictures) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def remember(folder: Path, key: str, extraction: CachedExtraction) -> None:
    """Write the list, once all pictures are in the folder.

    Raises:
        OSError: the folder cannot be written.
    """
    document = {
        "key": key,
        "pictures": [astuple(picture) for picture in extraction.pictures],
        "seen": extraction.seen,
        "without_pose": extraction.without_pose,
        "on_ground": extraction.on_ground,
        "damaged": extraction.damaged,
    }
    temporary = folder / f"{_LIST}.part"
    temporary.write_text(json.dumps(document), encoding="utf-8")
    os.replace(temporary, folder / _LIST)
