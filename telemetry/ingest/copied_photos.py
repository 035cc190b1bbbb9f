"""Copies of photos: the same files in one folder, "DJI_0001 (1).JPG", or in a second one, under any names.

Those in a second folder, a backup beside the original perhaps, are told and not left out: a folder is a vehicle,
whatever it holds. A camera writes no two equal files: what has one size and one content in samples over the file, its
tags among them, is one exposure. Pictures without a time and a position of their own are not compared (but by their
names within a folder), since tables of poses may name pictures that look the same.
"""

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from orthoswarm.stores.addresses import is_stored
from telemetry.photos.photo_tags import read_photo
from telemetry.samples.unreadable import Unreadable, read_or_reason

_SAMPLE_BYTES, _SAMPLES = 16 << 10, 8

_COPY_NAME: Final = re.compile(r"\s*\(\d+\)|[\s_-]+copy(?:\s*\(?\d+\)?)?", re.IGNORECASE)  # after the photo's own name
_COPIED_LEAST: Final = 3  # two folders with so many photos in common may be one and its copy


class Copies(NamedTuple):
    """Photos that are the same files as others, with these: in their own folder, and in an earlier one."""

    within: dict[Path, Path]
    elsewhere: dict[Path, Path]


def copies_among(photos: Sequence[Path]) -> Copies:
    """Copies among the photos of all folders.

    Folders that have only one or two photos in common count as two. Only files that share their size with another are
    opened, and only those that begin like another are read beyond: raw pictures are all of one size, and each sample
    is a seek on a disk. Files in stores are not compared.
    """
    within: dict[Path, Path] = {}
    elsewhere: dict[Path, Path] = {}
    for of_one_size in _of_one_size(photos):
        for of_one_beginning in _alike(of_one_size, 0):
            for alike in _alike(of_one_beginning, _SAMPLES):
                within |= _within(alike)
                first, *others = (path for path in alike if path not in within)
                elsewhere |= {path: first for path in others if first.parent != path.parent and _is_exposure(first)}
    in_common: dict[tuple[Path, Path], set[Path]] = {}
    for copy, first in elsewhere.items():
        in_common.setdefault((copy.parent, first.parent), set()).add(first)
    many = {folders for folders, photos in in_common.items() if len(photos) >= _COPIED_LEAST}
    return Copies(within, {c: first for c, first in elsewhere.items() if (c.parent, first.parent) in many})


def _within(alike: Sequence[Path]) -> dict[Path, Path]:
    """Of equal files those that have another one in their folder and are named after it: IMG_1 (1), Copy of IMG_1."""
    found: dict[Path, Path] = {}
    for folder in dict.fromkeys(path.parent for path in alike):
        first, *others = sorted((p for p in alike if p.parent == folder), key=lambda p: (len(p.name), p.name))
        exposure = bool(others) and _is_exposure(first)
        for path in others:
            before, named, after = path.stem.partition(first.stem)
            more = before + after
            if named and (not more.isdigit() if exposure else _COPY_NAME.fullmatch(more)):
                found[path] = first
    return found


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
