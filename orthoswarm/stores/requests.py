"""Requests to stores, through fsspec: repeated when they fail, and failing in one sentence.

    Exception
    └── OrthoSwarmError
        ├── NotStoredError       there is no such file: this file alone is concerned
        │   └── RefusedError     it may not be read or written, and perhaps is not there
        ├── StoreRequestError    a store refuses one request again and again: this file alone is concerned
        ├── StoreLostError       a store cannot be reached, or says that it has too much to do: the run ends, and goes
        │                        on when started again
        └── StoreAccessError     packages or credentials are missing or no longer valid: as above, exit code 2

Credentials come from where the stores' own libraries look for them (environment, ~/.aws, ~/.config/gcloud, the
machine's role), addresses of other servers from AWS_ENDPOINT_URL and STORAGE_EMULATOR_HOST.
"""

import errno
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import quote

from orthoswarm.model.errors import InputError, OrthoSwarmError, RunInterruptedError
from orthoswarm.stores.addresses import address_of, split_stored

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
_LOGGED_OUT = (("google.auth.exceptions", "RefreshError"), ("orthoswarm.stores.google_store", "EndedLoginError"))
_LOGGED_OUT_CODES = frozenset(
    {"ExpiredToken", "TokenRefreshRequired", "InvalidToken", "InvalidAccessKeyId", "SignatureDoesNotMatch"}
    | {"RequestTimeTooSkewed", "400"}  # S3 answers a request without a body (HEAD) by this number alone
)
_BUSY = frozenset({429, 502, 503, 504})
"""Statuses by which a store says that it, or what stands before it, cannot serve anybody now."""
CONNECTIONS: Final = 16
"""Requests at once of a process that reads tags, copies or uploads: a request mostly waits for the network."""
_ATTEMPTS: Final = 5  # at a request that fails: with the waits below a store may be away for some seconds
_FIRST_WAIT_S: Final = 0.5  # before the second attempt; each further one is twice as long (usual for S3) ...
_LONGEST_WAIT_S: Final = 10.0  # ... up to this
_BUSY_S: Final = 60.0
"""So long a store may answer that it has too much to do before the run ends, seconds: S3 takes some ten seconds to some
minutes to spread a prefix that suddenly gets many requests."""
_TIMEOUT_S: Final = 30.0  # longest silence of a store within a request
_file_systems: dict[tuple[str, int], Any] = {}


class NotStoredError(OrthoSwarmError):
    """There is no such file in the store."""


class RefusedError(NotStoredError):
    """A file may not be read or written, and perhaps is not there: stores do not tell whom they refuse."""


class StoreRequestError(OrthoSwarmError):
    """A store answers, but not with what was asked for."""


class StoreLostError(RunInterruptedError):
    """A store cannot be reached, or cannot serve anybody now."""


class StoreAccessError(RunInterruptedError, InputError):
    """Packages or credentials are missing, or no longer valid: no other file would be given, either."""


def file_system(path: Path) -> Any:
    """The file system of fsspec for a path, one for each process.

    Raises StoreAccessError: if the packages for it are not installed.
    """
    scheme = path.parts[1].rstrip(":")
    key = (scheme, os.getpid())
    if key not in _file_systems:
        _file_systems[key] = _connected(scheme)
    return _file_systems[key]


def request(path: Path, what: Callable[[Any, str], T]) -> T:
    """What a function gives of fsspec's file system and its name of a path, after some attempts.

    The name is bucket and key, or the whole address on the web, quoted.

    Args:
        path: in a store. what: the request; may be repeated.

    Raises:
        NotStoredError, StoreRequestError, StoreLostError, StoreAccessError: see above.
    """
    scheme, key = split_stored(path)
    if scheme.startswith("http"):
        key = f"{scheme}://{quote(key, safe='/:@')}"
    began, attempt = time.monotonic(), 1
    while True:
        try:
            return what(file_system(path), key)
        except Exception as error:  # each backend raises errors of its own library
            _raise_final(path, error)
            status = _status(error)
            if status in _BUSY:
                if time.monotonic() - began > _BUSY_S:
                    raise StoreLostError(
                        f"the store of {address_of(path)} has too much to do (status {status}) for "
                        f"{_BUSY_S:.0f} s; run the same command again later to go on"
                    ) from None
            elif attempt >= _ATTEMPTS:
                _raise_spent(path, error, attempt)
        time.sleep(min(_FIRST_WAIT_S * 2 ** (attempt - 1), _LONGEST_WAIT_S))
        attempt += 1


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
        raise StoreAccessError(f"{scheme}:// needs the package {package}; pip install orthoswarm[cloud]") from None


def _settings(scheme: str) -> dict[str, Any]:
    """Nothing that is listed is kept by fsspec; silence is bounded; attempts are counted here."""
    settings: dict[str, Any] = {"use_listings_cache": False, "skip_instance_cache": True}
    if scheme == "s3":
        retries = {"max_attempts": 1, "mode": "standard"}
        settings["config_kwargs"] = {"read_timeout": _TIMEOUT_S, "connect_timeout": _TIMEOUT_S, "retries": retries}
    else:
        import aiohttp

        bounds = aiohttp.ClientTimeout(total=None, sock_connect=_TIMEOUT_S, sock_read=_TIMEOUT_S)
        settings |= {"requests_timeout": bounds} if scheme == "gs" else {"client_kwargs": {"timeout": bounds}}
    return settings


def _raise_final(path: Path, error: Exception) -> None:
    """Raise what no further attempt would change."""
    address = address_of(path)
    if isinstance(error, FileNotFoundError):
        raise NotStoredError(f"{address} is not there; check the address") from None
    if _is(error, _NO_CREDENTIALS):
        raise StoreAccessError(
            f"there are no credentials for {address}; set them as for the store's own program (docs/cluster.md)"
        ) from None
    if isinstance(error, PermissionError) and not _is_logged_out(error):
        raise RefusedError(
            f"{address} is refused by its store; check the address, or give credentials that may use it"
        ) from None
    if isinstance(error, ImportError):
        raise StoreAccessError(f"{address} needs a package ({error}); pip install orthoswarm[cloud]") from None
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
        raise error
    if isinstance(error, OrthoSwarmError):
        raise error


def _raise_spent(path: Path, error: Exception, attempts: int) -> None:
    address = address_of(path)
    if _is_logged_out(error):
        raise StoreAccessError(
            f"the login for {address} is no longer valid; log in again (docs/cluster.md) and run the same command again"
        ) from None
    if isinstance(error, ConnectionError) or _is(error, _GONE):
        raise StoreLostError(
            f"the store of {address} cannot be reached; run the same command again to go on when it is back"
        ) from None
    raise StoreRequestError(f"{address} failed in {attempts} attempts ({_short(error)}); try again later") from None


def _is_logged_out(error: BaseException | None) -> bool:
    """Whether a store does not accept the credentials, whatever they are used for."""
    if _is(error, _LOGGED_OUT):
        return True
    return any(_response(each).get("Error", {}).get("Code") in _LOGGED_OUT_CODES for each in _chain(error))


def _status(error: BaseException) -> int | None:
    """The HTTP status that an error of any of the libraries tells."""
    for each in _chain(error):
        told = _response(each).get("ResponseMetadata", {}).get("HTTPStatusCode")
        for status in (told, getattr(each, "status", None), getattr(each, "code", None)):
            if isinstance(status, int):
                return status
            if isinstance(status, str) and status.isdigit():
                return int(status)
    return None


def _response(error: BaseException) -> dict[str, Any]:
    """What S3 has answered, as botocore's errors have it."""
    found = getattr(error, "response", None)
    return found if isinstance(found, dict) else {}


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and its causes."""
    while error is not None:
        yield error
        error = error.__cause__


def _is(error: BaseException | None, kinds: tuple[tuple[str, str], ...]) -> bool:
    """Whether an error or one of its causes is of a library's type; a library that was not imported raised nothing."""
    types = tuple(getattr(sys.modules[m], name, ()) for m, name in kinds if m in sys.modules)
    return any(isinstance(each, types) for each in _chain(error))


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0][:160] or type(error).__name__
