"""Google Cloud Storage through gcsfs, with gcsfs's own retries and lookups switched off.

By itself gcsfs repeats a failed request up to five times in half a minute and prints each failure, though
`requests.request` counts the attempts here; it looks up each file before it fetches it; and its default file system
first asks over gRPC for the class of a bucket, which takes a minute where nobody answers. Since that question is left
out, buckets of the class Rapid cannot be used.
"""

import inspect
import io
import mimetypes
import os
from pathlib import Path
from typing import Any

from aiohttp import ClientResponse
from gcsfs.core import GCSFileSystem

_ONE_REQUEST = 5 << 20  # gcsfs uploads smaller files in one
_once = inspect.unwrap(GCSFileSystem._request)


class AnonymousError(PermissionError):
    """A request without credentials was refused."""


class EndedLoginError(PermissionError):
    """A request was refused for its credentials."""


class GoogleFileSystem(GCSFileSystem):  # type: ignore[misc]
    """The file system of `gs://`: a failure is raised at once, and its type tells what it is.

    settings: as for gcsfs.
    """

    _get_file_request = inspect.unwrap(GCSFileSystem._get_file_request)

    def __init__(self, session_kwargs: dict[str, Any] | None = None, **settings: Any) -> None:
        session = {**(session_kwargs or {}), "raise_for_status": _raise_refusal}
        super().__init__(session_kwargs=session, **settings)

    async def _request(self, *args: Any, data: Any = None, **kwargs: Any) -> Any:
        sent = io.BytesIO(data) if isinstance(data, bytes | bytearray | memoryview) else data  # aiohttp warns of bytes
        return await _once(self, *args, data=sent, **kwargs)

    async def _get_file(self, rpath: str, lpath: str, callback: Any = None, **kwargs: Any) -> None:
        await super()._get_file(rpath, lpath, callback=callback, concurrency=1, **kwargs)

    async def _put_file(self, lpath: str, rpath: str, **kwargs: Any) -> None:
        """Upload a file; one that ends with a carriage return as gcsfs does it with large ones.

        In a single request gcsfs ends a file by a line feed: with a carriage return before it, a server may take both
        for the end of the line (gcp-storage-emulator does), and the file that it keeps is a byte shorter.
        """
        small = os.path.isfile(lpath) and 0 < os.path.getsize(lpath) < _ONE_REQUEST
        data = Path(lpath).read_bytes() if small else b""
        if data.endswith(b"\r"):
            kind = mimetypes.guess_type(lpath)[0] or "application/octet-stream"
            await self._pipe_file(rpath, data, chunksize=len(data), content_type=kind, consistency="size")
        else:
            await super()._put_file(lpath, rpath, consistency="size", **kwargs)


async def _raise_refusal(response: ClientResponse) -> None:
    """Raise by type what gcsfs tells in a text alone; at the text "Forbidden" it tries what else may be allowed."""
    if response.status == 401 and "Authorization" not in response.request_info.headers:
        raise AnonymousError(f"Forbidden: {response.url.path}")
    if response.status == 401:
        raise EndedLoginError(f"Forbidden: {response.url.path}")
    if response.status == 403:
        raise PermissionError(f"Forbidden: {response.url.path}")
