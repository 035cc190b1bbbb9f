"""Addresses of files in stores, written as paths.

A file in a store is the path `/s3:/bucket/folder/name.jpg` everywhere inside: an absolute path that no file system
has, so that names, folders and common parents are found as for any path, and so that it means the same in every
process. Its address, `s3://bucket/folder/name.jpg`, is what users write and read.
"""

import re
from pathlib import Path

_ADDRESS = re.compile(r"(s3|gs|https?)://(.*)", re.IGNORECASE)
_STORED = re.compile(r"/(s3|gs|https?):/(.*)")


def path_of(text: str) -> Path:
    """The path of an address (`s3://bucket/photos`), or of anything else that names a file."""
    found = _ADDRESS.fullmatch(text)
    return Path(f"/{found[1].lower()}:/{found[2].strip('/')}") if found else Path(text)


def is_stored(path: Path) -> bool:
    """Whether a path lies in a store."""
    parts = path.parts
    return len(parts) > 1 and parts[1] in ("s3:", "gs:", "http:", "https:") and not path.drive


def address_of(path: Path) -> str:
    """The address of a path in a store; of a local path, the path itself."""
    found = _STORED.fullmatch(path.as_posix()) if is_stored(path) else None
    return f"{found[1]}://{found[2]}" if found else str(path)
