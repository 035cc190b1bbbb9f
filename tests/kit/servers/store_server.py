"""Servers of object storage on loopback, and a proxy before them that fails as told."""

import http.client
import os
import re
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.kit.servers.ports import free_port


@dataclass(frozen=True, kw_only=True)
class StoreKind:
    """A protocol of object storage.

    Attributes:
        packages: without which there is neither server nor client. command: of the server, before its port.
        ready: a path that a server answers. endpoint: the variable that leads clients to it. environment: further ones.
        part: in the paths of requests that upload parts of a large file.
    """

    scheme: str
    packages: tuple[str, ...]
    command: tuple[str, ...]
    ready: str
    endpoint: str
    environment: dict[str, str]
    part: str

    def require(self):
        """Skip a test where packages are missing."""
        for name in self.packages:
            pytest.importorskip(name, reason=f"{self.scheme}:// needs the extra 'dev'")


S3 = StoreKind(
    scheme="s3",
    packages=("s3fs", "moto", "flask_cors"),
    command=("moto.server", "-H", "127.0.0.1", "-p"),
    ready="/moto-api/",
    endpoint="AWS_ENDPOINT_URL",
    environment={
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
    },
    part="partNumber",
)
GS = StoreKind(
    scheme="gs",
    packages=("gcsfs", "gcp_storage_emulator"),
    command=("gcp_storage_emulator", "start", "--in-memory", "--quiet", "--host", "127.0.0.1", "--port"),
    ready="/",
    endpoint="STORAGE_EMULATOR_HOST",
    environment={"GOOGLE_APPLICATION_CREDENTIALS": os.devnull, "NO_GCE_CHECK": "true"},
    part="upload_id",
)
KINDS = {kind.scheme: kind for kind in (S3, GS)}


@contextmanager
def store_server(kind):
    """A server process; yields its address."""
    port = free_port()
    command = [sys.executable, "-m", *kind.command, str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        address = f"http://127.0.0.1:{port}"
        end = time.monotonic() + 240
        while True:
            try:
                urllib.request.urlopen(f"{address}{kind.ready}", timeout=30).close()
                break
            except OSError:
                assert server.poll() is None and time.monotonic() < end, f"the {kind.scheme} server did not start"
                time.sleep(0.1)
        yield address
    finally:
        server.kill()
        server.wait(120)


class FaultyProxy:
    """A proxy on loopback; `fault(method, path)` gives None, a status (with a body), or seconds before the answer.

    Attributes:
        address: of the proxy. kind: of the store. seen: (method, path with query) of each request; small uploads to
            Google's storage name their object in the body, and the path ends with it here.
    """

    def __init__(self, target, kind):
        self.kind = kind
        self.fault = lambda method, path: None
        self.seen = []
        proxy = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_one(self):
                length = int(self.headers.get("Content-Length") or 0)
                body = self.rfile.read(length) if length else None
                path = self.path
                if "uploadType=multipart" in path:
                    path += "&name=" + re.search(rb'"name": "([^"]*)"', body)[1].decode()
                proxy.seen.append((self.command, path))
                fault = proxy.fault(self.command, path)
                if isinstance(fault, float):
                    time.sleep(fault)
                elif fault is not None:
                    status, body = fault if isinstance(fault, tuple) else (fault, b"")
                    return self.answer(status, {}, body)
                headers = {k: v for k, v in self.headers.items() if k.lower() not in ("connection",)}
                behind = http.client.HTTPConnection(target.removeprefix("http://"), timeout=240)
                behind.request(self.command, self.path, body, headers)
                answer = behind.getresponse()
                self.answer(answer.status, answer.headers, answer.read())
                behind.close()
                return None

            def answer(self, status, headers, data):
                self.send_response(status)
                for name, value in headers.items():
                    if name.lower() not in ("connection", "transfer-encoding", "content-length", "date", "server"):
                        self.send_header(name, value)
                size = headers.get("Content-Length") if self.command == "HEAD" else None
                self.send_header("Content-Length", size or str(len(data)))
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(data)

            do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = handle_one

            def log_message(self, *_):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self):
        self._server.shutdown()
        self._server.server_close()
