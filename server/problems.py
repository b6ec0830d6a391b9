"""Errors on their way to a client: one table from exception to status, one shape (RFC 9457, ``application/problem+json``)."""

import json
import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Final

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match, Route

from schemas.errors import ClipmapError, NotFoundError, UsageError
from server.cors import CORS_HEADERS

MEDIA_TYPE: Final = "application/problem+json"
_log: Final = logging.getLogger(__name__)


class StaleVersionError(ClipmapError):
    """The URL names a version of the dataset that is not the current one."""


class DamagedError(ClipmapError):
    """The stored dataset contradicts itself; the text is for clients, the cause (with paths) is for the log."""


class UnavailableError(ClipmapError):
    """A dataset is there but has never been readable since the service started."""


class RangeNotSatisfiableError(ClipmapError):
    """The requested byte range begins behind the last of ``length_bytes`` bytes."""

    def __init__(self, length_bytes: int) -> None:
        super().__init__(f"the range begins behind the last of {length_bytes} bytes")
        self.length_bytes = length_bytes


STATUS: Final[tuple[tuple[type[ClipmapError], HTTPStatus], ...]] = (
    (UsageError, HTTPStatus.BAD_REQUEST),
    (NotFoundError, HTTPStatus.NOT_FOUND),
    (StaleVersionError, HTTPStatus.GONE),
    (RangeNotSatisfiableError, HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE),
    (UnavailableError, HTTPStatus.SERVICE_UNAVAILABLE),
    (DamagedError, HTTPStatus.INTERNAL_SERVER_ERROR),
)
"""Which error is answered with which status. Any other error is a fault of the service: 500, and its text stays in the log."""

_INTERNAL: Final = "the service failed to answer; its log says why"


def problem_response(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return a problem document; it is never cached, since the next version of a dataset may answer the same URL."""
    problem = {"type": "about:blank", "title": HTTPStatus(status).phrase, "status": int(status), "detail": detail}
    return Response(
        json.dumps(problem).encode(),
        int(status),
        media_type=MEDIA_TYPE,
        headers={"Cache-Control": "no-store", **CORS_HEADERS, **(headers or {})},
    )


def add_problem_handlers(app: FastAPI) -> None:
    """Make every error of ``app``, the framework's own included, a problem document."""
    app.add_exception_handler(ClipmapError, _clipmap_error)
    app.add_exception_handler(RequestValidationError, _malformed)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(Exception, _unexpected)


async def _clipmap_error(request: Request, error: Exception) -> Response:
    status = next((status for kind, status in STATUS if isinstance(error, kind)), None)
    if status is None:
        _log.error("%s %s: %s", request.method, request.url.path, error)
        return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, _INTERNAL)
    if status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        _log.error("%s %s: %s", request.method, request.url.path, error.__cause__ or error)
    headers = {"Content-Range": f"bytes */{error.length_bytes}"} if isinstance(error, RangeNotSatisfiableError) else None
    return problem_response(status, str(error), headers)


async def _malformed(_request: Request, error: Exception) -> Response:
    # A URL that cannot be understood is a 400; FastAPI's 422 is for bodies that are understood but wrong.
    if not isinstance(error, RequestValidationError):
        raise error
    first = error.errors()[0]
    return problem_response(HTTPStatus.BAD_REQUEST, f"{first['loc'][-1]}: {first['msg'].removeprefix('Value error, ')}")


async def _http_error(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    if error.status_code == HTTPStatus.NOT_FOUND:
        return problem_response(HTTPStatus.NOT_FOUND, f"nothing is served at {request.url.path}; /datasets lists what there is")
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        allowed = ", ".join(sorted(_allowed_methods(request)))
        detail = f"{request.url.path} answers {allowed} only"
        return problem_response(HTTPStatus.METHOD_NOT_ALLOWED, detail, {"Allow": allowed})
    return problem_response(error.status_code, str(error.detail), error.headers)


def _allowed_methods(request: Request) -> set[str]:
    """Return the methods of all routes at the request's path: the framework names only those of the first."""
    routes = (route for route in request.app.routes if isinstance(route, Route))
    return {method for route in routes if route.matches(request.scope)[0] is not Match.NONE for method in route.methods or ()} | {"OPTIONS"}


async def _unexpected(_request: Request, _error: Exception) -> Response:
    # The framework raises the error again after this answer, and the HTTP server logs it with its traceback.
    return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, _INTERNAL)
