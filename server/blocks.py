"""The hot path: from a block's address or name to its stored bytes, without a look inside them."""

from typing import Final

from starlette.requests import Request
from starlette.responses import Response

from schemas.address import BlockAddress, parse_block_name
from schemas.errors import InputError, NotFoundError
from server.catalog import Catalog
from server.conditional import IMMUTABLE, REVALIDATE, Representation, answer
from server.cors import CORS_HEADERS
from server.problems import DamagedError, StaleVersionError
from server.slots import PublishedDataset

_ATTEMPTS: Final = 3
"""How often a dataset may be rebuilt under one request before it is given up."""


def cache_control(published: PublishedDataset, version: str | None) -> str:
    """Return the Cache-Control of a URL that names ``version`` (None: names none).

    Raises StaleVersionError if another version is current: blocks of two versions side by side show seams.
    """
    if version is None:
        return REVALIDATE
    if version != published.version:
        raise StaleVersionError(
            f"dataset {published.name!r} is at version {published.version} now, not {version!r}; read its manifest again"
        )
    return IMMUTABLE


def named_address(published: PublishedDataset, layer_name: str, block_name: str) -> BlockAddress:
    """Return the address of the block called ``block_name`` in a layer.

    Raises UsageError if it is no block name, NotFoundError if it is one of another layer or of another pyramid.
    """
    layer = published.dataset.manifest.layer(layer_name)
    parsed = parse_block_name(block_name)
    if (parsed.layer, parsed.levels, parsed.suffix) != (layer_name, len(layer.levels), layer.suffix):
        raise NotFoundError(
            f"{block_name!r} is no block of layer {layer_name!r}: its names end in .{layer.suffix}, "
            f"and level and digits of the quadtree code add up to {len(layer.levels) - 1}"
        )
    return parsed.address


def block_response(
    catalog: Catalog, request: Request, dataset: str, layer: str, block: BlockAddress | str, version: str | None
) -> Response:
    """Return the answer to a request for one block, by address or by name.

    A rebuild may publish a new version and delete the old blocks between the look at the manifest and the read of the
    block; such a request starts again with the new version and can never mix the two. Raises NotFoundError,
    UsageError, StaleVersionError, RangeNotSatisfiableError, UnavailableError, or DamagedError if a block that
    the index lists is missing or has another length.
    """
    for _ in range(_ATTEMPTS):
        published = catalog.dataset(dataset)
        cache = cache_control(published, version)
        address = named_address(published, layer, block) if isinstance(block, str) else block
        published.dataset.manifest.layer(layer).lattice.check(address)
        try:
            return _stored_block(request, published, layer, address, cache)
        except (NotFoundError, InputError) as error:
            if catalog.dataset(dataset) is published:
                raise DamagedError(
                    f"block {address} of layer {layer!r} of dataset {dataset!r} cannot be served: it or its index is damaged or missing; "
                    "rebuild the layer"
                ) from error
    raise DamagedError(f"dataset {dataset!r} was rebuilt {_ATTEMPTS} times during one request; ask again")


def _stored_block(request: Request, published: PublishedDataset, layer: str, address: BlockAddress, cache: str) -> Response:
    dataset = published.dataset
    record = dataset.record(layer, address)
    if record.blank:
        return Response(status_code=204, headers={"Cache-Control": cache, **CORS_HEADERS})

    def read() -> bytes:
        return dataset.block(layer, address) or b""

    media_type = dataset.manifest.layer(layer).media_type
    return answer(request, Representation(media_type, f'"{record.digest}"', record.length_bytes, read), cache)
