"""Small grey copies of all pictures in one file, from which seam lines are chosen without reading the pictures again.

Each picture has a record of fixed size, whatever its shape, so that processes write their own without a lock. A record
that was never written is zero (the file is sparse).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.errors import StorageError
from orthoswarm.raster.picture_quality import LEAST_SIDE_PX, picture_quality

Bytes = NDArray[np.uint8]

ROWS, COLUMNS = 240, 320
BLOCK_PX = 20
"""Side of the blocks of which the local contrast is stated."""
RECORD = np.dtype(
    [
        ("gray", np.uint8, (ROWS, COLUMNS)),
        ("contrast", np.float32, (ROWS // BLOCK_PX, COLUMNS // BLOCK_PX)),
        ("sharpness", np.float32),
        ("written", np.uint32),
    ]
)


@dataclass(frozen=True, slots=True)
class PreviewFile:
    """The previews of a set of pictures.

    Attributes:
        path: the file, made by `create`.
        row: image -> number of its record.
    """

    path: Path
    row: Mapping[str, int]

    @classmethod
    def create(cls, path: Path, images: Sequence[str]) -> "PreviewFile":
        """A file for these images; one that is there already is kept if it has their number of records.

        Raises:
            StorageError: if it cannot be written.
        """
        size = RECORD.itemsize * len(images)
        try:
            if not path.exists() or path.stat().st_size != size:
                with path.open("wb") as file:
                    file.truncate(size)
        except OSError as error:
            raise StorageError(f"{path} cannot be written ({error.strerror}); free some disk space") from None
        return cls(path, {image: row for row, image in enumerate(images)})


def write_preview(path: Path, row: int, picture: Bytes) -> None:
    """Store the preview of a picture, uint8 (H, W, 3).

    Raises:
        StorageError: if the disk is full.
    """
    record = make_preview(picture)
    try:
        with path.open("r+b") as file:
            file.seek(row * RECORD.itemsize)
            file.write(record.tobytes())
    except OSError as error:
        raise StorageError(f"{path} cannot be written ({error.strerror}); free some disk space") from None


def make_preview(picture: Bytes) -> NDArray[np.void]:
    """The record of a picture, uint8 (H, W, 3): an array of one element of dtype RECORD."""
    import cv2

    config = active().mosaic
    record = np.zeros(1, RECORD)
    gray = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    blocks = (COLUMNS // BLOCK_PX, ROWS // BLOCK_PX)
    level = gray.astype(np.float32)
    mean = cv2.resize(level, blocks, interpolation=cv2.INTER_AREA)
    square = cv2.resize(level * level, blocks, interpolation=cv2.INTER_AREA)
    glare = cv2.resize((gray >= config.glare_level).astype(np.float32), blocks, interpolation=cv2.INTER_AREA)
    record["gray"][0] = gray
    record["contrast"][0] = np.sqrt(np.maximum(square - mean * mean, 0.25)) * (glare <= config.glare_share)
    sharp = picture_quality(picture).sharpness if min(picture.shape[:2]) >= LEAST_SIDE_PX else 0.0
    record["sharpness"] = max(sharp, 1e-3)
    record["written"] = 1
    return record


def read_previews(path: Path, rows: NDArray[np.integer]) -> NDArray[np.void]:
    """Some records (N,) of dtype RECORD."""
    records = np.zeros(len(rows), RECORD)
    with path.open("rb", buffering=0) as file:
        for i, row in enumerate(rows.tolist()):
            file.seek(row * RECORD.itemsize)
            file.readinto(records[i : i + 1].view(np.uint8).data)
    return records


def unwritten(path: Path, rows: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Which of some records were never written, bool (N,)."""
    at = RECORD.fields["written"][1] if RECORD.fields is not None else 0
    missing = np.ones(len(rows), bool)
    with path.open("rb") as file:
        for i, row in enumerate(rows.tolist()):
            file.seek(row * RECORD.itemsize + at)
            missing[i] = file.read(4).strip(b"\0") == b""
    return missing
