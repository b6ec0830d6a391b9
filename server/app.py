"""The block service as an ASGI application."""

import json
from collections.abc import Callable
from importlib.metadata import version as installed_version
from typing import Any, Final

from fastapi import FastAPI, Request
from starlette.responses import Response

from schemas.address import BlockAddress
from schemas.manifest import digest
from schemas.settings import ServerSettings
from server import reference
from server.blocks import block_response, cache_control
from server.catalog import Catalog
from server.conditional import REVALIDATE, Representation, answer
from server.cors import CORS_HEADERS, Preflight
from server.listing import Health, catalogue
from server.problems import add_problem_handlers
from server.reference import BlockName, Column, DatasetName, LayerName, LevelNumber, Row, Version

_JSON: Final = "application/json"
_ABOUT: Final = (
    "Hands out the stored blocks of clipmap datasets by level, column and row, without ever decoding them. "
    "Every resource answers GET and HEAD; every error is a problem document."
)


def create_app(settings: ServerSettings) -> FastAPI:
    """Return the block service for the datasets of ``settings.roots``; it holds no state outside the returned object.

    Raises NotFoundError, InputError or StorageError for a root that cannot be used, UsageError for two datasets of one name.
    """
    catalog = Catalog(settings.roots)
    # The framework's documentation pages load scripts from other people's servers; /openapi.json is served below.
    app = FastAPI(title="clipmap", description=_ABOUT, version=installed_version("clipmap"), openapi_url=None, redirect_slashes=False)
    app.state.catalog = catalog
    app.add_middleware(Preflight)
    add_problem_handlers(app)
    _add_service_routes(app, catalog)
    _add_dataset_routes(app, catalog)
    return app


def _serve(app: FastAPI, path: str, endpoint: Callable[..., Any], responses: reference.Responses) -> None:
    """Answer GET and HEAD of ``path`` with ``endpoint``; the framework does not add HEAD by itself."""
    usual = next(status for status in responses if isinstance(status, int))
    app.add_api_route(
        path, endpoint, methods=["GET"], status_code=usual, responses=responses, response_class=Response, operation_id=endpoint.__name__
    )
    app.add_api_route(path, endpoint, methods=["HEAD"], include_in_schema=False, response_class=Response)


def _document(request: Request, data: bytes) -> Response:
    return answer(request, Representation(_JSON, f'"{digest(data)}"', len(data), lambda: data), REVALIDATE)


# Endpoints that touch the disk are plain functions, which the framework runs on its thread pool: a slow disk then holds
# up one thread, not the event loop and with it every other client. The price, with blocks of 20 kB in the page cache, 16
# connections and one process on a two-core machine (wrk): 1.5 to 1.9 thousand requests/s, against 2.7 to 3.1 thousand if
# coroutines read the files; but there a single cold read of 10 ms stops everybody for 10 ms. /healthz is a coroutine
# that needs no thread, so that a supervisor gets its answer even while all threads wait for a disk.


def _add_service_routes(app: FastAPI, catalog: Catalog) -> None:
    async def root() -> Response:
        """Redirect to the catalogue."""
        return Response(status_code=307, headers={"Location": "datasets", **CORS_HEADERS})

    def datasets(request: Request) -> Response:
        """All datasets in service: version, layers, and where to find manifest and blocks.

        Links are relative to this document. New, rebuilt and removed datasets are noticed without a restart.
        """
        return _document(request, catalogue(catalog).model_dump_json().encode())

    async def healthz() -> Response:
        """Say that the service is up; touches no disk and never waits for a thread."""
        health = Health(version=app.version, datasets=len(catalog.names()))
        return Response(health.model_dump_json(), media_type=_JSON, headers={"Cache-Control": "no-store", **CORS_HEADERS})

    def openapi(request: Request) -> Response:
        """This reference as an OpenAPI document."""
        return _document(request, json.dumps(reference.openapi_document(app)).encode())

    _serve(app, "/", root, reference.ROOT_RESPONSES)
    _serve(app, "/datasets", datasets, reference.CATALOGUE_RESPONSES)
    _serve(app, "/healthz", healthz, reference.HEALTH_RESPONSES)
    _serve(app, "/openapi.json", openapi, reference.OPENAPI_RESPONSES)


def _add_dataset_routes(app: FastAPI, catalog: Catalog) -> None:
    def manifest(request: Request, dataset: DatasetName, v: Version = None) -> Response:
        """Everything a client must know about a dataset: layers, lattices, levels, codecs, availability of blocks."""
        published = catalog.dataset(dataset)
        data = published.manifest_json
        return answer(request, Representation(_JSON, published.manifest_etag, len(data), lambda: data), cache_control(published, v))

    def block(
        request: Request, dataset: DatasetName, layer: LayerName, level: LevelNumber, x: Column, y: Row, v: Version = None
    ) -> Response:
        """One block by level, column and row: its stored bytes."""
        return block_response(catalog, request, dataset, layer, BlockAddress(level, x, y), v)

    def named_block(request: Request, dataset: DatasetName, layer: LayerName, name: BlockName, v: Version = None) -> Response:
        """One block by its name, with level and quadtree code: its stored bytes."""
        return block_response(catalog, request, dataset, layer, name, v)

    _serve(app, "/{dataset}/manifest.json", manifest, reference.MANIFEST_RESPONSES)
    _serve(app, "/{dataset}/{layer}/q/{name}", named_block, reference.BLOCK_RESPONSES)
    _serve(app, "/{dataset}/{layer}/{level}/{x}/{y}", block, reference.BLOCK_RESPONSES)
