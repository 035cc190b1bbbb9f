"""Addresses of files in stores, written as paths.

A file in a store is the path `/s3:/bucket/folder/name.jpg` everywhere inside: an absolute path that no file system
has, so that names, folders and common parents are found as for any path, and so that it means the same in every
process. Its address, `s3://bucket/folder/name.jpg`, is what users write and read. On the web that is the address of
a browser, in which `%20` stands for a space; keys of object storage are names as they are.
"""

import re
from pathlib import Path
from urllib.parse import unquote

_ADDRESS = re.compile(r"(s3|gs|https?)://(.*)", re.IGNORECASE)
_STORED = re.compile(r"/(s3|gs|https?):/(.*)")


def path_of(text: str) -> Path:
    """The path of an address (`s3://bucket/photos`), or of anything else that names a file."""
    found = _ADDRESS.fullmatch(text)
    if not found:
        return Path(text)
    scheme, rest = found[1].lower(), found[2].strip("/")
    return Path(f"/{scheme}:/{unquote(rest) if scheme.startswith('http') else rest}")


def is_stored(path: Path) -> bool:
    """Whether a path lies in a store."""
    parts = path.parts
    return len(parts) > 1 and parts[1] in ("s3:", "gs:", "http:", "https:") and not path.drive


def address_of(path: Path) -> str:
    """The address of a path in a store, from which `path_of` makes the path again; of a local path, the path itself.

    On the web spaces and letters stay readable; only what `path_of` would take for an escape is escaped.
    """
    scheme, rest = split_stored(path)
    return f"{scheme}://{rest.replace('%', '%25') if scheme.startswith('http') else rest}" if scheme else str(path)


def split_stored(path: Path) -> tuple[str, str]:
    """Scheme and the rest of a path in a store, the names as they are; the scheme of a local path is empty."""
    found = _STORED.fullmatch(path.as_posix()) if is_stored(path) else None
    return (found[1], found[2]) if found else ("", str(path))
