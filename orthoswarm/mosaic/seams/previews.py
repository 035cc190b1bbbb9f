"""Small grey copies of all pictures in one file, from which seam lines are chosen without reading the pictures again.

Each picture has a record of fixed size, whatever its shape, so that processes write their own without a lock. A record
that was never written is zero (the file is sparse).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Bytes, Flags, Floats, Ints
from orthoswarm.model.errors import StorageError
from orthoswarm.raster.picture_quality import LEAST_SIDE_PX, picture_quality

ROWS, COLUMNS = 240, 320
BLOCK_PX = 20  # side of the blocks of which the local contrast is stated
RECORD = np.dtype(
    [
        ("gray", np.uint8, (ROWS, COLUMNS)),
        ("contrast", np.float32, (ROWS // BLOCK_PX, COLUMNS // BLOCK_PX)),
        ("sharpness", np.float32),
        ("written", np.uint32),
    ]
)

GLARE_LEVEL: Final = 240  # grey levels from here on are taken for glints of water or burnt-out ground
_GLARE_SHARE: Final = 0.05  # a block of the preview with a larger share of glare says nothing about haze


@dataclass(frozen=True, slots=True)
class PreviewFile:
    """The previews of a set of pictures.

    path: the file, made by `create`. row: image -> number of its record.
    """

    path: Path
    row: Mapping[str, int]

    @classmethod
    def create(cls, path: Path, images: Sequence[str]) -> "PreviewFile":
        """A file for these images; one that is there already is kept if it has their number of records.

        Raises:
            StorageError: if it cannot be written.
        """
        size = RECORD.itemsize * max(
            len(images), 2
        )  # a lone record would be contiguous, for which kernels have no code
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
        with path.open("r+b", buffering=0) as file:
            file.seek(row * RECORD.itemsize)
            record.tofile(file)
    except OSError as error:
        raise StorageError(f"{path} cannot be written ({error.strerror}); free some disk space") from None


def make_preview(picture: Bytes) -> NDArray[np.void]:
    """The record of a picture, uint8 (H, W, 3): an array of one element of dtype RECORD."""
    import cv2

    record = np.zeros(1, RECORD)
    gray = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    record["gray"][0] = gray
    _contrasts(record["gray"][0], record["contrast"][0])
    sharp = picture_quality(picture).sharpness if min(picture.shape[:2]) >= LEAST_SIDE_PX else 0.0
    record["sharpness"] = max(sharp, 1e-3)
    record["written"] = 1
    return record


@in_place_kernel
def _contrasts(gray, contrast):  # type: ignore[no-untyped-def]
    """Standard deviation of each block of a preview, at least half a level; 0 where too much of it is glare."""
    pixels = np.int64(BLOCK_PX * BLOCK_PX)
    for i in range(contrast.shape[0]):
        for j in range(contrast.shape[1]):
            total, square, glare = np.int64(0), np.int64(0), np.int64(0)
            for r in range(i * BLOCK_PX, (i + 1) * BLOCK_PX):
                row = gray[r, j * BLOCK_PX : (j + 1) * BLOCK_PX]
                for c in range(BLOCK_PX):
                    level = np.int64(row[c])
                    total += level
                    square += level * level
                    glare += np.int64(level >= GLARE_LEVEL)
            variance = (pixels * square - total * total) / (pixels * pixels)
            contrast[i, j] = np.sqrt(max(variance, 0.25)) if glare <= _GLARE_SHARE * pixels else 0.0


@dataclass(frozen=True, slots=True)
class Previews:
    """Previews of N pictures.

    Attributes:
        gray: uint8 (M, ROWS, COLUMNS), grey copies of all pictures of the file, mapped and not read.
        rows: int32 (N,), which of them are meant.
        contrast: float32 (N, ROWS / BLOCK_PX, COLUMNS / BLOCK_PX), of the parts of the pictures, levels.
        sharpness: float32 (N,), see picture_quality. written: bool (N,), whether there is a preview.
    """

    gray: Bytes
    rows: Ints
    contrast: Floats
    sharpness: Floats
    written: Flags

    @classmethod
    def of(cls, records: NDArray[np.void], rows: NDArray[np.integer]) -> "Previews":
        """Some of the records (M,) of dtype RECORD."""
        contrast, sharpness, written = (records[name][rows] for name in ("contrast", "sharpness", "written"))
        return cls(records["gray"], rows.astype(np.int32), contrast, sharpness, written > 0)


def read_previews(path: Path, rows: NDArray[np.integer]) -> Previews:
    """Some previews of a file."""
    return Previews.of(np.asarray(np.memmap(path, RECORD, mode="r")), rows)


def unwritten(path: Path, rows: NDArray[np.integer]) -> Flags:
    """Which of some records were never written, bool (N,)."""
    at = RECORD.fields["written"][1] if RECORD.fields is not None else 0
    missing = np.ones(len(rows), bool)
    with path.open("rb") as file:
        for i, row in enumerate(rows.tolist()):
            file.seek(row * RECORD.itemsize + at)
            missing[i] = file.read(4).strip(b"\0") == b""
    return missing
