"""Conditional and partial answers: If-None-Match, Range and If-Range (RFC 9110, sections 13 and 14)."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from starlette.requests import Request
from starlette.responses import Response

from server.cors import CORS_HEADERS
from server.problems import RangeNotSatisfiableError

_ENTITY_TAG: Final = re.compile(r'(?:W/)?("[^"]*")')
_SINGLE_RANGE: Final = re.compile(r"bytes=[ \t]*([0-9]{0,30})-([0-9]{0,30})[ \t]*", re.IGNORECASE)

IMMUTABLE: Final = "public, max-age=31536000, immutable"
"""For URLs that name a version: their bytes never change."""
REVALIDATE: Final = "public, no-cache"
"""For URLs that do not: keep the bytes, but ask before using them; the 304 costs no read."""


@dataclass(frozen=True, slots=True)
class Representation:
    """What a URL stands for right now: its bytes, not yet read, and what is known of them beforehand."""

    media_type: str
    etag: str
    """Strong entity tag, quotes included."""
    length_bytes: int
    read: Callable[[], bytes]


def etag_matches(if_none_match: str, etag: str) -> bool:
    """Whether the field value lists ``etag``, compared weakly as If-None-Match demands; ``*`` matches anything."""
    return if_none_match.strip() == "*" or etag in _ENTITY_TAG.findall(if_none_match)


def byte_range(field: str, length_bytes: int) -> tuple[int, int] | None:
    """Return the half-open (start, stop) that a Range field asks for, None if all bytes are to be sent.

    None stands for what RFC 9110 section 14.2 lets a server ignore: other units, malformed fields, several ranges.
    Raises RangeNotSatisfiableError if the range has no byte of the representation.
    """
    match = _SINGLE_RANGE.fullmatch(field)
    if match is None:
        return None
    first, last = match.groups()
    if not first and not last:
        return None
    if not first:
        start, stop = max(0, length_bytes - int(last)), length_bytes
    else:
        start, stop = int(first), min(int(last) + 1, length_bytes) if last else length_bytes
        if last and int(last) < start:
            return None
    if start >= length_bytes:
        raise RangeNotSatisfiableError(length_bytes)
    return start, stop


def answer(request: Request, representation: Representation, cache_control: str) -> Response:
    """Return 304, 206 or 200 as the request's conditions demand; 304 and HEAD never read the bytes.

    Raises RangeNotSatisfiableError, and whatever ``representation.read`` raises.
    """
    fields = request.headers
    headers = {"ETag": representation.etag, "Cache-Control": cache_control, **CORS_HEADERS}
    if etag_matches(", ".join(fields.getlist("if-none-match")), representation.etag):
        return Response(status_code=304, headers=headers)
    headers["Accept-Ranges"] = "bytes"
    if request.method == "HEAD":
        headers["Content-Length"] = str(representation.length_bytes)
        return Response(media_type=representation.media_type, headers=headers)
    wanted = _wanted_range(fields, representation)
    data = representation.read()
    if wanted is None:
        return Response(data, media_type=representation.media_type, headers=headers)
    start, stop = wanted
    headers["Content-Range"] = f"bytes {start}-{stop - 1}/{representation.length_bytes}"
    return Response(data[start:stop], 206, media_type=representation.media_type, headers=headers)


def _wanted_range(fields: Mapping[str, str], representation: Representation) -> tuple[int, int] | None:
    field = fields.get("range")
    # If-Range compares strongly (RFC 9110, 13.1.5): a weak tag or a date never matches, and all bytes are sent.
    if field is None or fields.get("if-range", representation.etag) != representation.etag:
        return None
    return byte_range(field, representation.length_bytes)
