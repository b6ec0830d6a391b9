"""What the OpenAPI document says of statuses and headers; ``docs/HTTP.md`` is generated from it."""

from typing import Annotated, Any, Final

from fastapi import FastAPI, Path, Query
from pydantic import BaseModel, BeforeValidator, Field

from server.listing import Catalogue, Health
from server.problems import MEDIA_TYPE

_MAX_COORDINATE: Final = 2**31 - 1


class Problem(BaseModel):
    """An error (RFC 9457)."""

    type: str = Field(description="Always 'about:blank': the status says what kind of problem it is")
    title: str = Field(description="Name of the status")
    status: int = Field(description="HTTP status")
    detail: str = Field(description="One sentence: what is wrong, where, what to do")


def _whole_number(text: object) -> int:
    # One spelling per number, so that a block has one URL: neither '+1', '01' nor '1.0'.
    if isinstance(text, str) and text.isascii() and text.isdecimal() and len(text) <= 10 and (text == "0" or text[0] != "0"):
        number = int(text)
        if number <= _MAX_COORDINATE:
            return number
    raise ValueError(f"must be a whole number from 0 to {_MAX_COORDINATE}, written in decimal digits")


_Coordinate = BeforeValidator(_whole_number)
_limits: Final = {"ge": 0, "le": _MAX_COORDINATE}
DatasetName = Annotated[str, Path(description="Name of a dataset, as the catalogue has it")]
LayerName = Annotated[str, Path(description="Name of a layer, as the manifest has it", max_length=64)]
LevelNumber = Annotated[int, Path(description="Level; 0 is the finest", **_limits), _Coordinate]
Column = Annotated[int, Path(description="Column of the block, from the left", **_limits), _Coordinate]
Row = Annotated[int, Path(description="Row of the block, from the top", **_limits), _Coordinate]
# No longer name exists: the coordinates of a block fit in 31 levels.
BlockName = Annotated[str, Path(description="Block name, <layer>-<level>[-<quadcode>].<suffix>, e.g. height-2-031.lerc", max_length=128)]
Version = Annotated[
    str | None,
    Query(description="Version of the manifest that the client works with. If it is the current one, the answer may be cached for ever"),
]


def _header(text: str) -> dict[str, Any]:
    return {"description": text, "schema": {"type": "string"}}


_CORS: Final = _header("`*`: pages of any origin may read the answer")
_CACHE: Final = {
    "Cache-Control": _header("`public, max-age=31536000, immutable` if the URL has `v`, else `public, no-cache`"),
    "Access-Control-Allow-Origin": _CORS,
}
_REVALIDATED: Final = {"Cache-Control": _header("`public, no-cache`"), "Access-Control-Allow-Origin": _CORS}
_ETAG: Final = _header("Strong entity tag: the digest of the bytes")
_RANGES: Final = _header("`bytes`")
_TAGGED: Final = {"ETag": _ETAG, **_CACHE}
_BYTES: Final = {"schema": {"type": "string", "format": "binary"}}


def _problem(text: str, **headers: str) -> dict[str, Any]:
    described = {name.replace("_", "-"): _header(content) for name, content in headers.items()}
    described["Cache-Control"] = _header("`no-store`")
    described["Access-Control-Allow-Origin"] = _CORS
    return {
        "description": text,
        "content": {MEDIA_TYPE: {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}},
        "headers": described,
    }


Responses = dict[int | str, dict[str, Any]]
_NOT_MODIFIED: Final = {"description": "The client's copy is current: an entity tag of `If-None-Match` matches", "headers": _TAGGED}
_DEFAULT: Final = _problem("Anything else that goes wrong; the service's log says more")

BLOCK_RESPONSES: Final[Responses] = {
    200: {
        "description": "The stored bytes of the block",
        "content": {"*/*": _BYTES},
        "headers": {
            "Content-Type": _header("The layer's media type"),
            **_TAGGED,
            "Accept-Ranges": _RANGES,
        },
    },
    204: {"description": "The block is blank: it lies on the lattice and holds no valid sample", "headers": _CACHE},
    206: {
        "description": "The bytes that `Range` asks for: one range, of either form. "
        "Several ranges, and a range whose `If-Range` does not match, are answered with 200",
        "content": {"*/*": _BYTES},
        "headers": {
            "Content-Type": _header("The same as with 200"),
            "Content-Range": _header("`bytes first-last/all`"),
            **_TAGGED,
            "Accept-Ranges": _RANGES,
        },
    },
    304: {**_NOT_MODIFIED, "description": f"{_NOT_MODIFIED['description']}. The block is not read"},
    400: _problem("The URL is malformed: a coordinate is not a whole number, or the name is not a block name"),
    404: _problem("There is no such dataset, layer or level, or the block lies outside the lattice"),
    405: _problem("The method is not one of those in `Allow`", Allow="Methods that the URL answers"),
    410: _problem("`v` is not the current version: the dataset was rebuilt. Read the manifest again and drop blocks of the old version"),
    416: _problem("The range begins behind the last byte", Content_Range="`bytes */all`"),
    500: _problem("The block or its index is damaged or missing; the sentence says which block"),
    503: _problem("The dataset's manifest has not been readable since the service started, or its object store fails or is too slow"),
    "default": _DEFAULT,
}
MANIFEST_RESPONSES: Final[Responses] = {
    200: {
        "description": "The manifest",
        "content": {"application/json": {"schema": {"type": "object"}}},
        "headers": {**_TAGGED, "Accept-Ranges": _RANGES},
    },
    **{status: BLOCK_RESPONSES[status] for status in (206, 405, 410, 416, 503, "default")},
    304: _NOT_MODIFIED,
    404: _problem("There is no such dataset"),
}
_DOCUMENT_RESPONSES: Final[Responses] = {
    206: {**BLOCK_RESPONSES[206], "headers": {**BLOCK_RESPONSES[206]["headers"], **_REVALIDATED}},
    304: {**_NOT_MODIFIED, "headers": {"ETag": _ETAG, **_REVALIDATED}},
    405: BLOCK_RESPONSES[405],
    416: BLOCK_RESPONSES[416],
    "default": _DEFAULT,
}
_DOCUMENT_HEADERS: Final = {"ETag": _ETAG, **_REVALIDATED, "Accept-Ranges": _RANGES}
CATALOGUE_RESPONSES: Final[Responses] = {
    200: {"description": "The catalogue", "model": Catalogue, "headers": _DOCUMENT_HEADERS},
    **_DOCUMENT_RESPONSES,
}
OPENAPI_RESPONSES: Final[Responses] = {
    200: {
        "description": "The OpenAPI document",
        "content": {"application/json": {"schema": {"type": "object"}}},
        "headers": _DOCUMENT_HEADERS,
    },
    **_DOCUMENT_RESPONSES,
}
HEALTH_RESPONSES: Final[Responses] = {
    200: {
        "description": "The service is up",
        "model": Health,
        "headers": {"Cache-Control": _header("`no-store`"), "Access-Control-Allow-Origin": _CORS},
    },
    405: BLOCK_RESPONSES[405],
}
ROOT_RESPONSES: Final[Responses] = {
    307: {
        "description": "The catalogue is elsewhere",
        "headers": {"Location": _header("`datasets`"), "Access-Control-Allow-Origin": _CORS},
    },
    405: BLOCK_RESPONSES[405],
}


def openapi_document(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of ``app``; the framework knows no media type but its own for errors, so theirs is added here."""
    document = app.openapi()
    document["components"]["schemas"][Problem.__name__] = Problem.model_json_schema()
    return document
