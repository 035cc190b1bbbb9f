"""The page's files under addresses with their version, which browsers keep for good, and all texts compressed.

The page is loaded over radio links of some hundred kilobits a second: packed it is a quarter of its size. Its modules
name each other by "/static/...", which an import map in the page turns into the versioned addresses.
"""

import base64
import gzip
import hashlib
import mimetypes
from pathlib import Path
from typing import Any, Final

from fastapi import HTTPException, Request, Response
from starlette.middleware.gzip import GZipMiddleware

from gcs_plugin.web.guard import CONTENT_POLICY

_PACKED: Final = frozenset({".js", ".mjs", ".css", ".html", ".txt", ".md", ".svg", ".json"})
_KEPT: Final = "public, max-age=31536000, immutable"
_ASKED: Final = "no-cache"  # the ETag is asked for each time
_WORTH_BYTES: Final = 1400  # what fits in one packet comes no sooner for being smaller
_PICTURES: Final = ("/picture", "/view", ".png")
_LEVEL: Final = 1  # 100 MB a second; higher ones save a tenth and take four times as long


class Assets:
    """The files of a folder, read once: they do not change while the daemon runs."""

    def __init__(self, folder: Path) -> None:
        found = sorted(path for path in folder.rglob("*") if path.is_file())
        self._files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}
        self._packed: dict[str, bytes] = {}
        digest = hashlib.sha256()
        for name, content in self._files.items():
            digest.update(name.encode() + b"\0" + content)
        self.version = f"v-{digest.hexdigest()[:12]}"

    def file(self, path: str, request: Request) -> Response:
        """A file; one under its version may be kept for good."""
        name, kept = path.removeprefix(f"{self.version}/"), path.startswith(f"{self.version}/")
        if name not in self._files:
            raise HTTPException(404, "there is no such file; load the page again")
        headers = {"ETag": f'"{self.version}"', "Cache-Control": _KEPT if kept else _ASKED, "Vary": "Accept-Encoding"}
        if f'"{self.version}"' in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        suffix, content = Path(name).suffix, self._files[name]
        kind = "text/javascript" if suffix in (".js", ".mjs") else mimetypes.guess_type(name)[0]
        if suffix in _PACKED and "gzip" in request.headers.get("accept-encoding", ""):
            if name not in self._packed:
                self._packed[name] = gzip.compress(content, mtime=0)
            content, headers["Content-Encoding"] = self._packed[name], "gzip"
        return Response(content, media_type=kind or "application/octet-stream", headers=headers)

    def page(self, name: str) -> Response:
        """A page with versioned addresses, and the import map for what its modules name."""
        versioned = f'"/static/{self.version}/'.encode()
        imports = b'{"imports": {"/static/": ' + versioned + b'"}}'
        script = b'<script type="importmap">' + imports + b"</script>\n<script type"
        text = self._files[name].replace(b'"/static/', versioned).replace(b"<script type", script, 1)
        allowed = base64.b64encode(hashlib.sha256(imports).digest()).decode()
        headers = {
            "Cache-Control": _ASKED,
            "Content-Security-Policy": f"{CONTENT_POLICY}; script-src 'self' 'sha256-{allowed}'",
        }
        return Response(text, media_type="text/html", headers=headers)


class Packed:
    """ASGI middleware that compresses answers in JSON; pictures, tiles and exports are compressed as they are."""

    def __init__(self, app: Any) -> None:
        self.app, self._packed = app, GZipMiddleware(app, minimum_size=_WORTH_BYTES, compresslevel=_LEVEL)

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """Handle one request."""
        path = scope.get("path", "")
        is_text = path.startswith("/api/") and not path.endswith(_PICTURES) and not path.startswith("/api/export/")
        await (self._packed if is_text else self.app)(scope, receive, send)
