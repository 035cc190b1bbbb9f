"""Lists the inputs: pictures by folder, videos, pose tables, logs; names relative to the inputs' root."""

import contextlib
import hashlib
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final

from orthoswarm.model.errors import InputError
from orthoswarm.raster.picture_file import PICTURE_SUFFIXES
from orthoswarm.stores.addresses import address_of, is_stored
from orthoswarm.stores.listing import exists, is_file, list_folder
from telemetry.formats.log.flight_logs import LOG_SUFFIXES
from telemetry.photos.photo_tags import read_photo, sensor_of_name
from telemetry.samples.unreadable import Unreadable, read_or_reason

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".ts", ".m2ts", ".mts", ".mpg", ".mpeg", ".mkv", ".flv", ".avi"}
    | {".h264", ".264", ".avc", ".h265", ".265", ".hevc", ".webm"}
)
UNREAD_SUFFIXES = frozenset(
    {".fit", ".tcx", ".igc", ".kml", ".kmz", ".plt", ".ubx", ".sbf", ".obs", ".rnx", ".rtk", ".dat", ".bag", ".mcap"}
    | {".json", ".geojson", ".xml", ".gpkg", ".shp", ".xlsx", ".ods", ".xmp"}
)
"""Files that may hold positions or times of pictures, and are not read."""
_UNREAD_PICTURES = frozenset({".heic", ".heif", ".avif"})
_TABLES = frozenset({".txt", ".csv"})
_SUBTITLES = frozenset({".srt"})
_OF_SYSTEMS: Final = frozenset({"@eaDir", "#recycle", "$RECYCLE.BIN", "System Volume Information", "__MACOSX"})
"""Folders of thumbnails, of what was deleted, and of macOS's twins that storage and systems add."""
_COPY = "a copy of another photo in its folder"
_ALREADY = "which is in the input already"
_OTHER_NAME = f"the same file as one of another name, {_ALREADY}"
_SAMPLE_BYTES, _SAMPLES = 16 << 10, 8
_COPY_NAME: Final = re.compile(r"\s*\(\d+\)|[\s_-]+copy(?:\s*\(?\d+\)?)?", re.IGNORECASE)  # after the photo's own name
_COPIED_LEAST: Final = 3  # two folders with so many photos in common may be one and its copy


@dataclass(slots=True, kw_only=True)
class Folder:
    """One folder that contains usable files."""

    path: Path  # of the folder
    vehicle: str  # id of the vehicle whose photos it contains
    # files with a picture's suffix; videos; logs; subtitles (SRT); tables (text and CSV), in natural order
    pictures: list[Path] = field(default_factory=list)
    videos: list[Path] = field(default_factory=list)
    logs: list[Path] = field(default_factory=list)
    subtitles: list[Path] = field(default_factory=list)
    tables: list[Path] = field(default_factory=list)
    sidecars: dict[Path, Path] = field(default_factory=dict)  # XMP beside pictures
    unread: list[Path] = field(default_factory=list)  # other files that may say something about pictures

    def take_sidecars(self) -> None:
        """Match XMP files with the pictures that they are named like: `DJI_0001.xmp` or `DJI_0001.JPG.xmp`."""
        files = {path.name.lower(): path for path in self.unread if path.suffix.lower() == ".xmp"}
        for picture in self.pictures if files else ():
            names = f"{picture.name}.xmp".lower(), f"{picture.stem}.xmp".lower()
            own = next((files[name] for name in names if name in files), None)
            if own is not None:
                self.sidecars[picture] = own
        used = set(self.sidecars.values())
        self.unread = [path for path in self.unread if path not in used]


@dataclass(frozen=True, slots=True)
class Discovery:
    """All folders of the inputs, and the root of picture names."""

    root: Path  # names are relative to it
    folders: list[Folder]  # those with usable files
    # files with a picture's suffix that are not read, the reason (one for all that share it) and a detail
    left_out: list[tuple[Path, str, str]] = field(default_factory=list)
    # the vehicle of each video, unless its metadata names another
    videos: dict[Path, str] = field(default_factory=dict)
    # tables and logs given by themselves or in folders without pictures and videos
    everywhere: frozenset[Path] = frozenset()
    _: KW_ONLY
    unreadable: dict[Path, str] = field(default_factory=dict)  # folders that cannot be listed -> the system's reason
    # photos that are the same files as photos in another folder, with these
    copies: dict[Path, Path] = field(default_factory=dict)

    def scope(self, path: Path) -> Path:
        """The folder whose pictures and videos (subfolders included) a table or log applies to."""
        return self.root if path in self.everywhere else path.parent

    def name(self, path: Path) -> str:
        """A file's name in all products: relative to the root, forward slashes, writable as UTF-8."""
        folder = _relative(str(path.parent), str(self.root))
        return _text(path.name if folder == os.curdir else os.path.join(folder, path.name))


@lru_cache(maxsize=1024)
def _relative(folder: str, root: str) -> str:
    return os.path.relpath(folder, root)


def _text(name: str) -> str:
    """A path as text: bytes of its name that are not UTF-8 are escaped, as no file format could hold them."""
    return name.replace(os.sep, "/").encode("utf-8", "backslashreplace").decode()


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key in which DJI_2 comes before DJI_10; case is ignored."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in _DIGITS.split(name.lower()) if part)


_DIGITS = re.compile(r"([0-9]{1,18})")


def discover(inputs: Sequence[Path], exclude: Sequence[Path] = ()) -> Discovery:
    """List the inputs' files, without hidden files and folders and everything below `exclude`.

    A video or photo given by itself includes the files next to it that describe its pose: the SRT of the same name,
    geo.txt and CSV. Logs must be given, as those of other flights may be there.

    Raises InputError: no input, or one that does not exist or is a folder that cannot be listed.
    """
    if not inputs:
        raise InputError("no input was given; name a folder of photos or a video")
    absolute = [path if is_stored(path) else Path(os.path.abspath(path)) for path in inputs]
    for original, path in zip(inputs, absolute, strict=True):
        if not exists(path):
            raise InputError(f"{address_of(original)} does not exist; check the path")
    single = {path for path in absolute if is_file(path)}
    tops = [path.parent if path in single else path for path in absolute]
    root = Path(os.path.commonpath(tops))
    outside = {os.path.abspath(path) for path in exclude}
    folders: dict[Path, Folder] = {}
    seen: dict[str, Path] = {}
    left_out: dict[Path, tuple[str, str]] = {}
    sorted_in: set[Path] = set()
    unreadable: dict[Path, str] = {}
    inside = [(file, True) for path in absolute if path not in single for file in _walk(path, outside, unreadable)]
    for path in absolute:
        if path in unreadable:
            raise InputError(f"the folder {path} cannot be read ({unreadable[path]}); check its permissions")
    named = [path for path in absolute if path in single]
    files = [*inside, *((path, False) for path in named), *((path, True) for path in _with_side_files(named))]
    real_folder = lru_cache(maxsize=None)(os.path.realpath)
    links = [(file.is_symlink(), file, walked) for file, walked in files]
    for is_link, file, walked in sorted(links, key=lambda entry: entry[0]):  # the file itself before links to it
        if walked and file.name.startswith("."):
            left_out[file] = "a hidden file; rename it if it is a photo to be mapped", ""
            continue
        real = os.path.realpath(file) if is_link else os.path.join(real_folder(str(file.parent)), file.name)
        first = seen.setdefault(real, file)
        if first != file:
            same = first.name == file.name
            left_out[file] = (_twice(first.parent, root), "") if same else (_OTHER_NAME, first.name)
        elif file not in sorted_in:
            sorted_in.add(file)
            _sort_in(file, folders, explicit=not walked)
    for folder in folders.values():
        folder.take_sidecars()
        folder.pictures.sort(key=lambda path: natural_key(path.name))
    ordered = [folders[path] for path in sorted(folders, key=lambda p: natural_key(str(p)))]
    within, elsewhere = copies_among([path for folder in ordered for path in folder.pictures])
    for folder in ordered if within else ():
        folder.pictures = [path for path in folder.pictures if path not in within]
    _name_vehicles(ordered, root)
    pictures = [(file, *why) for file, why in left_out.items() if file.suffix.lower() in PICTURE_SUFFIXES]
    left = [entry for entry in pictures if entry[0] not in sorted_in]
    left += [(copy, _COPY, first.name) for copy, first in within.items()]
    if unreadable and not ordered and not left:
        path, why = next(iter(unreadable.items()))
        raise InputError(f"no picture was found, and the folder {path} cannot be read ({why}); check its permissions")
    apart = _far_from_pictures(tops, ordered)
    vehicles = _video_vehicles(ordered, root)
    return Discovery(root, ordered, left, vehicles, apart, unreadable=unreadable, copies=elsewhere)


def _twice(folder: Path, root: Path) -> str:
    """Why a photo that is in a folder, too, is left out; without its name, so that it is said once for all of them."""
    name = _text(_relative(str(folder), str(root)))
    return f"the same photos are in {_text(root.name) if name == os.curdir else name}, {_ALREADY}"


def _walk(top: Path, outside: set[str], unreadable: dict[Path, str]) -> list[Path]:
    """All files below a folder; folders that cannot be listed are entered into `unreadable` with the reason."""
    if is_stored(top):
        return _stored(top, outside)
    found: list[Path] = []

    def failed(error: OSError) -> None:
        unreadable[Path(error.filename)] = error.strerror or str(error)

    for folder, below, files in os.walk(top, onerror=failed):
        below[:] = sorted(
            name
            for name in below
            if not name.startswith(".") and name not in _OF_SYSTEMS and os.path.join(folder, name) not in outside
        )
        found += [Path(folder, name) for name in sorted(files, key=natural_key)]
    return found


def _stored(top: Path, outside: set[str]) -> list[Path]:
    """The files of a folder in a store in the order in which a local one is walked."""

    def hidden(path: Path) -> bool:
        folders = [folder for folder in path.parents if folder != top and folder.is_relative_to(top)]
        return any(f.name.startswith(".") or f.name in _OF_SYSTEMS or str(f) in outside for f in folders)

    files = [path for path in list_folder(top) if not hidden(path)]
    return sorted(files, key=lambda path: (path.parent.parts, natural_key(path.name)))


def _with_side_files(named: list[Path]) -> list[Path]:
    """Files next to videos and photos that describe their poses."""
    videos = {(path.parent, path.stem.lower()) for path in named if path.suffix.lower() in VIDEO_SUFFIXES}
    photos = {path.parent for path in named if path.suffix.lower() in PICTURE_SUFFIXES}
    found: list[Path] = []
    for folder in sorted(photos | {parent for parent, _ in videos}):
        try:
            files = sorted(_in_folder(folder))
        except OSError:  # a folder that may be entered but not listed
            continue
        for path in files:
            suffix = path.suffix.lower()
            table = suffix == ".csv" or path.name.lower() == "geo.txt"
            if (table and folder in photos) or (suffix in _SUBTITLES and (folder, path.stem.lower()) in videos):
                found.append(path)
    return found


def _in_folder(folder: Path) -> list[Path]:
    if is_stored(folder):
        return [path for path in list_folder(folder) if path.parent == folder]
    return [path for path in folder.iterdir() if path.is_file()]


def _far_from_pictures(tops: Sequence[Path], folders: list[Folder]) -> frozenset[Path]:
    """Tables and logs in given folders (or given by themselves in folders) without pictures and videos."""
    seen = {up for folder in folders if folder.pictures or folder.videos for up in (folder.path, *folder.path.parents)}
    apart = {top for top in tops if top not in seen}
    there = (folder for folder in folders if not apart.isdisjoint((folder.path, *folder.path.parents)))
    return frozenset(path for folder in there for path in (*folder.tables, *folder.logs))


def _sort_in(file: Path, folders: dict[Path, Folder], *, explicit: bool) -> None:
    suffix = file.suffix.lower()
    folder = folders.get(file.parent) or Folder(path=file.parent, vehicle="")
    kinds = (
        (PICTURE_SUFFIXES | _UNREAD_PICTURES, folder.pictures),
        (VIDEO_SUFFIXES, folder.videos),
        (LOG_SUFFIXES, folder.logs),
        (_SUBTITLES, folder.subtitles),
        (_TABLES, folder.tables),
        (UNREAD_SUFFIXES if not explicit else frozenset(), folder.unread),
    )
    for suffixes, where in kinds:
        if suffix in suffixes:
            where.append(file)
            folders[file.parent] = folder
            return
    if explicit:
        raise InputError(f"{file.name} is of a kind that cannot be read; name a folder of photos, a video or a log")


def _name_vehicles(folders: list[Folder], root: Path) -> None:
    names: set[str] = set()
    for folder in sorted(folders, key=lambda f: len(f.path.parts), reverse=True):
        relative = _text(os.path.relpath(folder.path, root))
        name = (_text(root.name) or "vehicle") if relative == "." else relative
        while name in names:
            name += "_top"
        names.add(name)
        folder.vehicle = name


def _video_vehicles(folders: list[Folder], root: Path) -> dict[Path, str]:
    """Each video is a vehicle named like it; by its path if cameras of several drones used the same name."""
    videos = [path for folder in folders for path in folder.videos]
    often = Counter([path.stem for path in videos] + [folder.vehicle for folder in folders if folder.pictures])
    paths = {path: _text(os.path.relpath(path, root)) for path in videos}
    twice = Counter(os.path.splitext(name)[0] for name in paths.values())
    return {
        path: _text(path.stem) if often[path.stem] == 1 else stem if twice[stem] == 1 else name
        for path, name in paths.items()
        for stem in [os.path.splitext(name)[0]]
    }


def copies_among(photos: Sequence[Path]) -> tuple[dict[Path, Path], dict[Path, Path]]:
    """Copies among the photos of all folders: in one folder, "DJI_0001 (1).JPG", or in a second one, under any names.

    Those in a second folder, a backup beside the original perhaps, are told and not left out: a folder is a vehicle,
    whatever it holds. A camera writes no two equal files: what has one size and one content in samples over the file,
    its tags among them, is one exposure. Pictures without a time and a position of their own are not compared (but by
    their names within a folder), since tables of poses may name pictures that look the same.

    Folders that have only one or two photos in common count as two. Only files that share their size with another are
    opened, and only those that begin like another are read beyond: raw pictures are all of one size, and each sample
    is a seek on a disk. Files in stores are not compared.

    Returns photos that are the same files as others, with these: in their own folder, and in an earlier one.
    """
    by_size: dict[int, list[Path]] = {}
    for path in photos:
        if not is_stored(path):
            with contextlib.suppress(OSError):  # reading it says what is wrong
                by_size.setdefault(os.stat(path).st_size, []).append(path)
    within: dict[Path, Path] = {}
    elsewhere: dict[Path, Path] = {}
    for of_one_size in (alike for size, alike in by_size.items() if size and len(alike) > 1):
        for of_one_beginning in _alike(of_one_size, 0):
            for alike in _alike(of_one_beginning, _SAMPLES):
                within |= _within(alike)
                first, *others = (path for path in alike if path not in within)
                elsewhere |= {path: first for path in others if first.parent != path.parent and _is_exposure(first)}
    in_common: dict[tuple[Path, Path], set[Path]] = {}
    for copy, first in elsewhere.items():
        in_common.setdefault((copy.parent, first.parent), set()).add(first)
    many = {folders for folders, photos in in_common.items() if len(photos) >= _COPIED_LEAST}
    return within, {c: first for c, first in elsewhere.items() if (c.parent, first.parent) in many}


def _within(alike: Sequence[Path]) -> dict[Path, Path]:
    """Of equal files those that have another one in their folder; the one with a number is the camera's own.

    Exposures are copies under any name that does not merely differ by its numbers, others if named after it.
    """
    found: dict[Path, Path] = {}
    for folder in dict.fromkeys(path.parent for path in alike):
        own = [path for path in alike if path.parent == folder]
        first, *others = sorted(own, key=lambda p: (not any(map(str.isdigit, p.stem)), len(p.name), p.name))
        exposure = bool(others) and _is_exposure(first)
        for path in others:
            before, named, after = path.stem.partition(first.stem)
            numbered = _DIGITS.sub("#", path.stem) == _DIGITS.sub("#", first.stem)
            another = exposure and not numbered and sensor_of_name(path.stem) == sensor_of_name(first.stem)
            if another or (named and _COPY_NAME.fullmatch(before + after)):
                found[path] = first
    return found


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
