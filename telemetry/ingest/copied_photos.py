"""Copies of photos: the same files in a second folder, a backup beside the original perhaps, under any names.

They are told and not left out: a folder is a vehicle, whatever it holds. A camera writes no two equal files: what has
one size and one content in samples over the file, its tags among them, is one exposure. Pictures without a time and a
position of their own are not compared, since tables of poses may name pictures that look the same.
"""

import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from orthoswarm.stores.addresses import is_stored
from telemetry.photos.photo_tags import read_photo
from telemetry.samples.unreadable import Unreadable, read_or_reason

_SAMPLE_BYTES, _SAMPLES = 16 << 10, 8

_COPIED_LEAST: Final = 3  # two folders with so many photos in common may be one and its copy


def copies_among(photos: Sequence[Path]) -> dict[Path, Path]:
    """Photos, of all folders, that are the same files as earlier ones in another folder, with these.

    Folders that have only one or two photos in common count as two. Only files that share their size with another are
    opened, and only those that begin like another are read beyond: raw pictures are all of one size, and each sample
    is a seek on a disk. Files in stores are not compared.
    """
    found: dict[Path, Path] = {}
    for of_one_size in _of_one_size(photos):
        for of_one_beginning in _alike(of_one_size, 0):
            for first, *others in _alike(of_one_beginning, _SAMPLES):
                found |= {path: first for path in others if first.parent != path.parent and _is_exposure(first)}
    in_common: dict[tuple[Path, Path], set[Path]] = {}
    for copy, first in found.items():
        in_common.setdefault((copy.parent, first.parent), set()).add(first)
    many = {folders for folders, photos in in_common.items() if len(photos) >= _COPIED_LEAST}
    return {copy: first for copy, first in found.items() if (copy.parent, first.parent) in many}


def _of_one_size(photos: Sequence[Path]) -> Iterator[list[Path]]:
    by_size: dict[int, list[Path]] = {}
    for path in photos:
        if not is_stored(path):
            try:
                by_size.setdefault(os.stat(path).st_size, []).append(path)
            except OSError:  # reading it says what is wrong
                continue
    return (alike for size, alike in by_size.items() if size and len(alike) > 1)


def _alike(photos: Sequence[Path], samples: int) -> list[list[Path]]:
    """Two and more of these that have one digest, in their order."""
    by_digest: dict[bytes, list[Path]] = {}
    for path in photos:
        digest = _digest(path, samples)
        if digest is not None:
            by_digest.setdefault(digest, []).append(path)
    return [alike for alike in by_digest.values() if len(alike) > 1]


def _digest(path: Path, samples: int) -> bytes | None:
    """A digest of the beginning, with the tags, and of samples up to the end; None if the file cannot be read."""
    try:
        if not path.is_file():  # reading a pipe would wait for ever
            return None
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.blake2b(digest_size=16)
            for k in range(samples + 1):
                file.seek(max(0, size - _SAMPLE_BYTES) * k // max(1, samples))
                digest.update(file.read(_SAMPLE_BYTES))
            return digest.digest()
    except OSError:
        return None


def _is_exposure(path: Path) -> bool:
    """Whether a photo's tags say when and where it was taken."""
    tags = read_or_reason(read_photo, path)
    return not (tags is None or isinstance(tags, Unreadable) or tags.time_s is None or tags.lat_deg is None)
