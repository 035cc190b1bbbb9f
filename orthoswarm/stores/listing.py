"""Folders in stores: which files they hold, with size and version.

A web server has no folders. One is listed by a file `files.txt` in it, a name a line (those of sub-folders with their
path), else by the links of its index page, as Apache, nginx and `python -m http.server` write them.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from orthoswarm.model.errors import InputError
from orthoswarm.stores.addresses import address_of, is_stored
from orthoswarm.stores.requests import NotStoredError, RefusedError, request

MANIFEST = "files.txt"
_SERVER_PARTS = 3  # parts of the path of a server itself: root, scheme, host


@dataclass(frozen=True, slots=True)
class StoredFile:
    """A file in a store."""

    size: int | None  # bytes, None where the store does not tell
    version: str  # changes with the content


_known: dict[Path, StoredFile] = {}


def known(path: Path) -> StoredFile | None:
    """What a listing of this process has told about a file."""
    return _known.get(path)


def remember(sizes: Mapping[Path, StoredFile]) -> None:
    """Take over what a listing of another process has told."""
    _known.update(sizes)


def look_up(path: Path) -> StoredFile:
    """Size and version of one file, as they are now.

    Raises NotStoredError: if it is not there. Else see `requests.request`.
    """
    info = request(path, lambda system, key: system.info(key))
    if info.get("type") == "directory":
        raise NotStoredError(f"{address_of(path)} is a folder and not a file; name a file")
    found = _described(info)
    _known[path] = found
    return found


def list_folder(folder: Path) -> list[Path]:
    """All files below a folder in a store, in the order of their paths; empty if there are none.

    Raises OrthoSwarmError: see `requests.request`.
    """
    if folder.parts[1].startswith("http"):
        return sorted(_web_folder(folder))
    found = request(folder, lambda system, key: system.find(key, detail=True))
    scheme = Path("/", folder.parts[1])
    for key, info in found.items():
        if info.get("type") == "file" and not key.endswith("/"):
            _known[scheme / key] = _described(info)
    return sorted(scheme / key for key, info in found.items() if info.get("type") == "file" and not key.endswith("/"))


def exists(path: Path) -> bool:
    """Whether there is a file or folder, local or in a store.

    Raises InputError: if its store refuses to tell. Else see `requests.request`.
    """
    if not is_stored(path):
        return path.exists()
    if path.parts[1].startswith("http"):
        return is_file(path) or bool(list_folder(path))
    try:
        return request(path, lambda system, key: bool(system.exists(key)))
    except RefusedError as error:
        raise InputError(str(error)) from None
    except NotStoredError:
        return False


def is_file(path: Path) -> bool:
    """Whether a path is a file, local or in a store; on the web a server, and a name without a suffix, is a folder."""
    if not is_stored(path):
        return path.is_file()
    if path in _known:
        return True
    if path.parts[1].startswith("http") and (not path.suffix or len(path.parts) <= _SERVER_PARTS):
        return False
    try:
        look_up(path)
    except NotStoredError:
        return False
    return True


def stamp(path: Path) -> str | None:
    """Size and version of a file in a store, as text; None if it is local or cannot be had."""
    if not is_stored(path):
        return None
    try:
        found = known(path) or look_up(path)
    except NotStoredError:
        return None
    return f"{found.size} {found.version}"


def _described(info: dict[str, Any]) -> StoredFile:
    """What fsspec tells about a file; the keys differ from store to store."""
    version = (
        info.get("ETag") or info.get("etag") or info.get("md5Hash") or info.get("LastModified") or info.get("mtime")
    )
    size = info.get("size")
    return StoredFile(None if size is None else int(size), str(version or ""))


def _web_folder(folder: Path) -> list[Path]:
    manifest = folder / MANIFEST
    try:
        text = request(manifest, lambda system, key: system.cat_file(key)).decode("utf-8", "replace")
    except NotStoredError:
        return _linked(folder)
    names = (line.strip() for line in text.splitlines())
    paths = [Path(os.path.normpath(folder / name)) for name in names if name and not name.startswith("#")]
    return [path for path in paths if path.is_relative_to(folder)]


def _linked(folder: Path) -> list[Path]:
    """The files that index pages link to, below the folder."""
    found: list[Path] = []
    todo, seen = [folder], {folder}
    while todo:
        here = todo.pop()
        for entry in _links(here):
            url = unquote(entry["name"].partition("?")[0].partition("#")[0])
            scheme, _, rest = url.partition("://")
            path = Path(f"/{scheme}:/{rest.strip('/')}")
            if path in seen or not path.is_relative_to(folder) or path.parent != here:
                continue
            seen.add(path)
            if url.endswith("/"):
                todo.append(path)
            elif path.name != "index.html":
                found.append(path)
    return found


def _links(folder: Path) -> Sequence[dict[str, Any]]:
    """What an index page links to; none if there is no page."""
    try:
        links: Sequence[dict[str, Any]] = request(folder, lambda system, key: system.ls(key + "/"))
    except NotStoredError:
        return ()
    return links
