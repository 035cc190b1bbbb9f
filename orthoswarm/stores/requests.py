"""Requests to stores, through fsspec: repeated when they fail, and failing in one sentence.

    Exception
    └── OrthoSwarmError
        ├── NotStoredError       there is no such file, or it may not be read: this file alone is concerned
        ├── StoreRequestError    a store refuses one request again and again: this file alone is concerned
        └── StoreLostError       a store cannot be reached: the run ends, and goes on when started again

Credentials come from where the stores' own libraries look for them (environment, ~/.aws, ~/.config/gcloud, the
machine's role), addresses of other servers from AWS_ENDPOINT_URL and STORAGE_EMULATOR_HOST.
"""

import errno
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from orthoswarm.config import active
from orthoswarm.model.errors import InputError, OrthoSwarmError, RunInterruptedError
from orthoswarm.stores.addresses import address_of

T = TypeVar("T")
_PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "http": "aiohttp", "https": "aiohttp"}
_GONE = (
    ("botocore.exceptions", "EndpointConnectionError"),
    ("botocore.exceptions", "ConnectTimeoutError"),
    ("aiohttp", "ClientConnectorError"),
    ("aiohttp", "ConnectionTimeoutError"),
    ("google.auth.exceptions", "TransportError"),
)
_NO_CREDENTIALS = (
    ("botocore.exceptions", "NoCredentialsError"),
    ("botocore.exceptions", "PartialCredentialsError"),
    ("google.auth.exceptions", "DefaultCredentialsError"),
    ("orthoswarm.stores.google_store", "AnonymousError"),
)
_LOGGED_OUT = (("google.auth.exceptions", "RefreshError"),)
_file_systems: dict[tuple[str, int], Any] = {}


class NotStoredError(OrthoSwarmError):
    """There is no such file in the store, or it may not be read."""


class StoreRequestError(OrthoSwarmError):
    """A store answers, but not with what was asked for."""


class StoreLostError(RunInterruptedError):
    """A store cannot be reached."""


def file_system(path: Path) -> Any:
    """The file system of fsspec for a path, one for each process.

    Raises:
        InputError: if the packages for it are not installed.
    """
    scheme = path.parts[1].rstrip(":")
    key = (scheme, os.getpid())
    if key not in _file_systems:
        _file_systems[key] = _connected(scheme)
    return _file_systems[key]


def key_of(path: Path) -> str:
    """What fsspec calls a path: bucket and key, or the whole address on the web, quoted."""
    scheme, _, rest = address_of(path).partition("://")
    return f"{scheme}://{quote(rest, safe='/:@')}" if scheme.startswith("http") else rest


def request(path: Path, what: Callable[[Any, str], T]) -> T:
    """What a function of fsspec's file system and the path's key gives, after some attempts.

    Args:
        path: in a store. what: the request; may be repeated.

    Raises:
        InputError: if packages or credentials are missing.
        NotStoredError, StoreRequestError, StoreLostError: see above.
    """
    config, key = active().stores, key_of(path)
    for attempt in range(1, config.attempts + 1):
        try:
            return what(file_system(path), key)
        except Exception as error:  # each backend raises errors of its own library
            _raise_final(path, error)
            if attempt == config.attempts:
                _raise_spent(path, error, attempt)
        time.sleep(config.first_wait_s * 2 ** (attempt - 1))
    raise AssertionError("unreachable")


def _connected(scheme: str) -> Any:
    try:
        if scheme == "gs":
            from orthoswarm.stores.google_store import GoogleFileSystem

            return GoogleFileSystem(**_settings(scheme))
        import fsspec

        system = fsspec.filesystem(scheme, **_settings(scheme))
        if hasattr(system, "retries"):
            system.retries = 1  # attempts are counted in `request`
        return system
    except ImportError:
        package = _PACKAGES[scheme]
        raise InputError(f"{scheme}:// needs the package {package}; pip install orthoswarm[cloud]") from None


def _settings(scheme: str) -> dict[str, Any]:
    """Nothing that is listed is kept by fsspec; silence is bounded; attempts are counted here."""
    limit = active().stores.timeout_s
    settings: dict[str, Any] = {"use_listings_cache": False, "skip_instance_cache": True}
    if scheme == "s3":
        retries = {"max_attempts": 1, "mode": "standard"}
        settings["config_kwargs"] = {"read_timeout": limit, "connect_timeout": limit, "retries": retries}
    else:
        import aiohttp

        bounds = aiohttp.ClientTimeout(total=None, sock_connect=limit, sock_read=limit)
        settings |= {"requests_timeout": bounds} if scheme == "gs" else {"client_kwargs": {"timeout": bounds}}
    return settings


def _raise_final(path: Path, error: Exception) -> None:
    """Raise what no further attempt would change."""
    address = address_of(path)
    if isinstance(error, FileNotFoundError):
        raise NotStoredError(f"{address} is not there; check the address") from None
    if _is(error, _NO_CREDENTIALS):
        raise InputError(
            f"there are no credentials for {address}; set them as for the store's own program (docs/cluster.md)"
        ) from None
    if isinstance(error, PermissionError):
        raise NotStoredError(f"{address} is refused by its store; give credentials that may use it") from None
    if isinstance(error, ImportError):
        raise InputError(f"{address} needs a package ({error}); pip install orthoswarm[cloud]") from None
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
        raise error
    if isinstance(error, OrthoSwarmError):
        raise error


def _raise_spent(path: Path, error: Exception, attempts: int) -> None:
    address = address_of(path)
    if isinstance(error, ConnectionError) or _is(error, _GONE):
        raise StoreLostError(
            f"the store of {address} cannot be reached; run the same command again to go on when it is back"
        ) from None
    if _is(error, _LOGGED_OUT):
        raise InputError(f"the login for {address} is no longer valid; log in again (docs/cluster.md)") from None
    raise StoreRequestError(f"{address} failed in {attempts} attempts ({_short(error)}); try again later") from None


def _is(error: BaseException | None, kinds: tuple[tuple[str, str], ...]) -> bool:
    """Whether an error or one of its causes is of a library's type; a library that was not imported raised nothing."""
    types = tuple(getattr(sys.modules[m], name, ()) for m, name in kinds if m in sys.modules)
    while error is not None:
        if isinstance(error, types):
            return True
        error = error.__cause__
    return False


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0][:160] or type(error).__name__
