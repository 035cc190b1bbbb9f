"""Responses of the HTTP API, the HTTP status of each error, and JSON bodies of requests."""

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NoReturn, TypeVar

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.requests import ClientDisconnect

from gcs_plugin.web.guard import TooLarge, bounded
from orthoswarm.export.atomic_file import FULL
from orthoswarm.export.json_values import json_text
from orthoswarm.model.errors import DiskFullError, InputError, OrthoSwarmError

Result = TypeVar("Result")

_MOST_JSON_BYTES: Final = 8_000_000
_BODY_S: Final = 30.0


class JsonAnswer(Response):
    """JSON in ASCII, so that any text, even with lone surrogates, can be sent; what is no number is null."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        """The body."""
        return json_text(content, compact=True).encode("ascii")


def status_of(error: OrthoSwarmError) -> int:
    """The HTTP status of one of this program's errors."""
    if isinstance(error, InputError):
        return 422
    return 507 if isinstance(error, DiskFullError) else 409


def install_error_answers(app: FastAPI) -> None:
    """Answer errors raised anywhere in a route as JSON with `detail`."""

    async def own(_: Request, error: Exception) -> Response:
        assert isinstance(error, OrthoSwarmError)
        return JsonAnswer({"detail": str(error)}, status_code=status_of(error))

    async def full(_: Request, error: Exception) -> Response:
        assert isinstance(error, OSError)
        if error.errno not in FULL:
            raise error
        return JsonAnswer({"detail": "the disk is full; free some space and send it again"}, status_code=507)

    async def timed_out(_: Request, error: Exception) -> Response:
        return JsonAnswer({"detail": "the links did not answer in time; try again"}, status_code=504)

    async def http(_: Request, error: Exception) -> Response:
        assert isinstance(error, StarletteHTTPException)
        return JsonAnswer({"detail": error.detail}, status_code=error.status_code, headers=error.headers)

    async def invalid(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        found = "; ".join(f"{'.'.join(str(part) for part in e['loc'])}: {e['msg']}" for e in error.errors())
        return JsonAnswer({"detail": f"the address is not valid ({found}); see /docs"}, status_code=422)

    app.add_exception_handler(OrthoSwarmError, own)
    app.add_exception_handler(OSError, full)
    app.add_exception_handler(TimeoutError, timed_out)
    app.add_exception_handler(StarletteHTTPException, http)
    app.add_exception_handler(RequestValidationError, invalid)


async def in_thread(pool: ThreadPoolExecutor, function: Callable[..., Result], *values: Any) -> Result:
    """Run a function in a pool's thread."""
    return await asyncio.get_running_loop().run_in_executor(pool, function, *values)


async def json_body(request: Request) -> dict[str, Any]:
    """The JSON object of a request; an empty one for an empty body."""
    data = await body_of(request, _MOST_JSON_BYTES)
    try:
        document = parse_json(data) if data.strip() else {}
    except ValueError:
        raise HTTPException(422, "the request is not JSON; send a JSON object") from None
    if not isinstance(document, dict):
        raise HTTPException(422, "the request is not a JSON object; send one")
    return document


async def body_of(request: Request, most_bytes: int) -> bytes:
    """The body of a request; raises HTTPException: it is larger than that, too slow, or the client disconnected."""
    request._receive = bounded(request.receive, most_bytes)
    try:
        async with asyncio.timeout(_BODY_S):
            return await request.body()
    except TooLarge as error:
        raise HTTPException(413, str(error)) from None
    except TimeoutError:
        raise HTTPException(408, "the request did not arrive in time; send it again") from None
    except ClientDisconnect:
        raise HTTPException(400, "the request is incomplete; send it again") from None


def parse_json(data: bytes | str) -> Any:
    """A JSON value; NaN and infinities, which are not JSON, are refused.

    Raises:
        ValueError: it is not JSON, or nested too deeply.
    """

    def refuse(name: str) -> NoReturn:
        raise ValueError(f"{name} is not JSON")

    try:
        return json.loads(data, parse_constant=refuse)
    except RecursionError:
        raise ValueError("nested too deeply") from None
