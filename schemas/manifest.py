"""The manifest: everything a reader must know about a dataset, in one JSON file that is written last.

``docs/FORMAT.md`` is the specification; the field descriptions here are its source, and ``docs/manifest.schema.json``
is generated from these models.
"""

import base64
import hashlib
import json
import zlib
from functools import cached_property
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from schemas.address import LAYER_NAME, BlockAddress, block_name
from schemas.errors import InputError, NotFoundError, UsageError
from schemas.lattice import Lattice, Registration
from schemas.light import Light, Normals
from schemas.model import Model

FORMAT_VERSION = 1
MANIFEST_NAME = "manifest.json"
INDEX_NAME = "index.bin"
MAX_LEVEL_BLOCKS = 1 << 31
"""So that a few bytes of a hostile manifest cannot make a reader allocate without bound."""

PATH_PATTERN = r"^[a-z][a-z0-9_.]*$"
MAX_PATCHES = 64
MAX_PATCHED_BLOCKS = 1 << 33
"""Of level 0, over all patches: their bitmaps, unpacked, take at most 1.4 GB."""
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
Transform = tuple[float, float, float, float, float, float]
SampleType = Literal["uint8", "uint16", "float32"]
LayerKind = Literal["imagery", "height", "light", "normal"]
Clamp = Literal["none", "local"]
KernelName = Literal["blackman-sinc", "kaiser", "lanczos", "triangle", "box"]


class World(Model):
    """The coordinate system that every layer's transform leads to."""

    crs: str | None = Field(description="Coordinate reference system, as AUTHORITY:CODE where there is one, else WKT; null if unknown")
    unit: Literal["metre", "degree", "foot", "us-foot", "unknown"] = Field(description="Unit of world coordinates")


class Source(Model):
    """Where a layer came from."""

    name: str = Field(description="File name of the source, without its folder; of a mosaic, that of the first")
    files: int = Field(default=1, ge=1, description="Number of files that a mosaic was put together from; 1 if it is none")
    format: str = Field(description="File format as its reader names it")
    width: int = Field(gt=0, description="Columns of the source [pixels]")
    height: int = Field(gt=0, description="Rows of the source [pixels]")
    channels: int = Field(gt=0, description="Channels of the source, alpha included")
    dtype: str = Field(description="Sample type of the source")
    file_bytes: int = Field(ge=0, description="Size of the source file [bytes]")
    nodata: float | None = Field(
        description="Value that marks a void, declared by the file or given, besides NaN and infinities; null if none"
    )
    decode: Literal["terrarium", "terrain-rgb"] | None = Field(description="How heights were hidden in colour; null if they were not")
    scale: float = Field(description="Factor from source values to layer values (heights: metres per unit)")
    offset: float = Field(description="Added after scaling (heights: metres)")
    stretch: list[tuple[float, float]] | None = Field(
        default=None, description="Range (min, max) of every colour channel that became 0 to 255, in units of the source; null if none did"
    )
    placement: Literal["georeferenced", "spacing", "fitted", "assumed"] = Field(
        description="Why the layer lies where it lies: the file says so, --spacing was given, it was fitted to the dataset's extent, "
        "or nothing is known and samples are one unit apart"
    )


class Filter(Model):
    """How coarser levels are made."""

    kernel: KernelName = Field(description="Kernel, one dimension of a separable filter")
    radius: int = Field(ge=1, description="Kernel radius [coarse samples]")
    edge: Literal["antisymmetric", "mirror", "mirror-sample"] = Field(
        description="What a filter sees beyond the source's edge: a point reflection about the outermost sample, a reflection about the "
        "outer side of the outermost cell, or one about the outermost sample"
    )
    clamp: Clamp = Field(default="none", description="'local': coarse samples were kept in the range of the valid samples under their taps")
    linear_light: bool = Field(default=False, description="Whether sRGB samples were decoded to light before and encoded after filtering")
    void: Literal["guarded-normalised"] = Field(
        default="guarded-normalised", description="How voids and alpha are weighed: normalised convolution with a guarded fallback"
    )


class Statistics(Model):
    """What level 0 holds, as stored values before encoding; voids and fully transparent samples do not count."""

    min: list[float] = Field(description="Smallest value per channel, alpha left out; empty if nothing is valid")
    max: list[float] = Field(description="Largest value per channel")
    mean: list[float] = Field(description="Mean per channel")
    valid: int = Field(ge=0, description="Samples of level 0 that are not void and not fully transparent")


class Level(Model):
    """One level of a layer."""

    level: int = Field(ge=0, description="0 is the finest")
    width: int = Field(gt=0, description="Columns [samples], without padding")
    height: int = Field(gt=0, description="Rows [samples], without padding")
    columns: int = Field(gt=0, description="Columns of blocks")
    rows: int = Field(gt=0, description="Rows of blocks")
    stored: int = Field(ge=0, description="Blocks that have bytes")
    blank: int = Field(ge=0, description="Blocks that hold no valid sample and have no bytes")
    stored_bytes: int = Field(ge=0, description="Bytes of all stored blocks of the level [bytes]")
    availability: str = Field(
        description="'all', or base64 of the zlib-compressed bitmap of stored blocks: row order, first block in the lowest bit "
        "of the first byte"
    )
    index: Digest = Field(description="BLAKE2b-128 of the level's block index")

    def stored_bitmap(self) -> bytes:
        """Return the bitmap of stored blocks, row order, lowest bit first; raises InputError if the field is damaged."""
        return unpack_bitmap(self.availability, self.columns * self.rows, f"the availability of level {self.level}")


class Patch(Model):
    """Blocks that an update wrote anew. They have a path of their own, so that no reader of the version before is given them."""

    path: str = Field(pattern=PATH_PATTERN, description="Prefix of these blocks in the store")
    levels: list[str] = Field(
        description="Per level, the finest first, the bitmap of the blocks that lie under this path, in the form of 'availability'"
    )


class Layer(Model):
    """One kind of sample on one lattice, as a pyramid of blocks."""

    kind: LayerKind = Field(description="What a sample is")
    path: str = Field(pattern=PATH_PATTERN, description="Prefix of the layer's blocks in the store; changes when a layer is rebuilt")
    patches: list[Patch] = Field(
        default=[],
        description="What updates wrote since: a block lies under the path of the last patch that has it, else under the layer's path; "
        "the indexes lie under that of the last patch",
    )
    registration: Registration = Field(description="'area': samples are cell centres. 'point': samples are grid vertices")
    width: int = Field(gt=0, description="Columns of level 0 [samples]")
    height: int = Field(gt=0, description="Rows of level 0 [samples]")
    block: int = Field(description="Side of a block's core [samples], a power of two")
    pad: int = Field(ge=0, description="Stored border of a block [samples]")
    channels: int = Field(ge=1, le=4, description="Channels of a stored sample, alpha included")
    alpha: bool = Field(description="Whether the last channel is alpha; colour is not premultiplied")
    dtype: SampleType = Field(description="Type of a decoded sample")
    unit: Literal["metre"] | None = Field(description="Unit of a sample; null for colour")
    codec: str = Field(description="Codec of the blocks with its parameters")
    suffix: str = Field(pattern=r"^[a-z0-9]+$", description="File suffix of block names")
    media_type: str = Field(description="Media type of a block")
    max_error: float | None = Field(
        ge=0,
        description="Largest absolute difference a decoded sample may have from the filtered one, rounding to the stored type aside "
        "[unit of a sample]; null if not bounded",
    )
    transform: Transform = Field(
        description="(a, b, c, d, e, f): world x = a*col + b*row + c, y = d*col + e*row + f, in level-0 sample coordinates "
        "[world units]. For 'area' whole numbers are cell corners, for 'point' they are the samples"
    )
    ground_spacing_m: tuple[float, float] | None = Field(
        description="Ground distance between samples along a row and along a column at the layer's centre [m]; null if unknown"
    )
    filter: Filter = Field(description="How coarser levels are made")
    fill: int = Field(default=0, ge=0, description="Voids up to this many samples across were filled before the pyramid was built")
    enhance: str | None = Field(
        default=None, description="How samples were enhanced before the pyramid was built, e.g. wavelet:1.5; null if they were not"
    )
    light: Light | None = Field(
        default=None,
        exclude_if=lambda light: light is None,
        description="What light this is; left out of layers of other kinds",
    )
    normals: Normals | None = Field(
        default=None,
        exclude_if=lambda normals: normals is None,
        description="What normals these are; left out of layers of other kinds",
    )
    source: Source = Field(description="Where the layer came from")
    statistics: Statistics = Field(description="What level 0 holds")
    levels: list[Level] = Field(min_length=1, description="All levels, the finest first")

    @property
    def lattice(self) -> Lattice:
        """The layer's lattice."""
        return Lattice(self.width, self.height, self.block, self.registration, self.pad)

    @property
    def paths(self) -> list[str]:
        """The prefixes under which the layer's blocks lie, the oldest first."""
        return [self.path, *(patch.path for patch in self.patches)]

    def block_path(self, address: BlockAddress) -> str:
        """Return the prefix under which a block lies; raises InputError if a patch's bitmap is damaged."""
        if self.patches:
            number = self.lattice.block_number(address)
            for patch in range(len(self.patches) - 1, -1, -1):
                bitmap = self._patch_bitmap(patch, address.level)
                if bitmap is None or bitmap[number // 8] >> number % 8 & 1:
                    return self.patches[patch].path
        return self.path

    def _patch_bitmap(self, patch: int, level: int) -> bytes | None:
        """Return the bitmap of a level in a patch, unpacked once; None if it has all blocks."""
        text = self.patches[patch].levels[level]
        if text == "all":
            return None
        known = self._bitmaps.get((patch, level))
        if known is None:
            entry = self.levels[level]
            known = unpack_bitmap(text, entry.columns * entry.rows, f"patch {self.patches[patch].path!r}")
            self._bitmaps[patch, level] = known
        return known

    @cached_property
    def _bitmaps(self) -> dict[tuple[int, int], bytes]:
        return {}

    def block_key(self, name: str, address: BlockAddress) -> str:
        """Return the store key of a block of this layer, which is called ``name`` in the manifest."""
        return block_key(self.block_path(address), name, address, len(self.levels), self.suffix)

    def index_key(self, level: int) -> str:
        """Return the store key of the block index of ``level``."""
        return index_key(self.paths[-1], level)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(x min, y min, x max, y max) in world coordinates of the area (``area``) or of the outermost samples (``point``)."""
        last = 0 if self.registration == "area" else 1
        return transformed_extent(self.transform, self.width - last, self.height - last)

    @model_validator(mode="after")
    def _levels_fit_lattice(self) -> Self:
        try:
            lattice = self.lattice
        except UsageError as error:
            raise ValueError(str(error)) from error
        columns, rows = lattice.block_counts(0)
        if columns * rows > MAX_LEVEL_BLOCKS:
            raise ValueError(f"level 0 would have {columns} x {rows} blocks, and more than {MAX_LEVEL_BLOCKS} are not supported")
        sizes = [(*lattice.level_size(n), *lattice.block_counts(n)) for n in range(lattice.levels)]
        if [(level.width, level.height, level.columns, level.rows) for level in self.levels] != sizes:
            raise ValueError(f"levels do not fit a lattice of {self.width} x {self.height} samples in blocks of {self.block}")
        if [level.level for level in self.levels] != list(range(lattice.levels)):
            raise ValueError("levels must be listed from 0, without gaps")
        if any(len(patch.levels) != lattice.levels for patch in self.patches):
            raise ValueError("a patch must have a bitmap per level")
        if (self.kind == "normal") != (self.normals is not None):
            raise ValueError("layers of kind 'normal', and only these, must have 'normals'")
        if self.normals is not None and self.channels != 2 + self.alpha:
            raise ValueError("layers of kind 'normal' must have two channels, and alpha if there is one")
        if len(self.patches) > MAX_PATCHES or len(self.patches) * columns * rows > MAX_PATCHED_BLOCKS:
            raise ValueError(f"{len(self.patches)} patches of a layer of {columns} x {rows} blocks are more than are supported")
        return self


def unpack_bitmap(text: str, count: int, what: str) -> bytes:
    """Return the bitmap of ``count`` blocks, row order, lowest bit first, that an ``availability`` field means.

    Raises InputError that begins with ``manifest:`` and ``what`` if it is damaged.
    """
    size = -(-count // 8)
    if text == "all":
        return b"\xff" * (count // 8) + bytes([(1 << count % 8) - 1] * (size - count // 8))
    try:
        packed = base64.b64decode(text, validate=True)
        stream = zlib.decompressobj()
        bitmap = stream.decompress(packed, size + 1)
    except (ValueError, zlib.error) as error:
        raise InputError(f"manifest: {what} is damaged ({error}); rebuild the layer") from error
    if len(bitmap) == size and (not stream.eof or stream.unused_data or int.from_bytes(bitmap, "little") >> count):
        raise InputError(f"manifest: {what} is cut off or has bits too many; rebuild the layer")
    if len(bitmap) != size:
        raise InputError(f"manifest: {what} has {len(bitmap)} bytes instead of {size}; rebuild the layer")
    return bitmap


def pack_bitmap(bitmap: bytes, count: int) -> str:
    """Return the ``availability`` field for a bitmap of ``count`` blocks; the inverse of ``unpack_bitmap``."""
    if int.from_bytes(bitmap, "little") == (1 << count) - 1:
        return "all"
    return base64.b64encode(zlib.compress(bitmap, 9)).decode("ascii")


def block_key(path: str, name: str, address: BlockAddress, levels: int, suffix: str) -> str:
    """Return the store key of a block: ``<path>/<level>/<block name>``."""
    return f"{path}/{address.level}/{block_name(name, address, levels, suffix)}"


def index_key(path: str, level: int) -> str:
    """Return the store key of the block index of a level: ``<path>/<level>/index.bin``."""
    return f"{path}/{level}/{INDEX_NAME}"


def transformed_extent(transform: Transform, width: float, height: float) -> tuple[float, float, float, float]:
    """(x min, y min, x max, y max) of the box ``[0, width] x [0, height]`` under an affine transform."""
    a, b, c, d, e, f = transform
    corners = [(a * x + b * y + c, d * x + e * y + f) for x in (0, width) for y in (0, height)]
    xs, ys = zip(*corners, strict=True)
    return min(xs), min(ys), max(xs), max(ys)


class Manifest(Model):
    """The whole dataset; ``version`` is a digest of ``world`` and ``layers``, so equal data have equal versions."""

    format: Literal["clipmap"] = Field(default="clipmap", description="Tells a manifest from other JSON files")
    format_version: int = Field(default=FORMAT_VERSION, ge=1, description="Readers refuse a greater number than they know")
    generator: str = Field(description="Program and version that wrote the manifest")
    version: Digest = Field(description="Digest of world and layers; changes whenever any block changes")
    world: World = Field(description="The coordinate system that every layer's transform leads to")
    layers: dict[str, Layer] = Field(min_length=1, description="Layers by name")

    @classmethod
    def create(cls, *, generator: str, world: World, layers: dict[str, Layer]) -> "Manifest":
        """Return a manifest with its version filled in; layers are kept in name order."""
        ordered = {name: layers[name] for name in sorted(layers)}
        return cls(generator=generator, version=_version(world, ordered), world=world, layers=ordered)

    @model_validator(mode="after")
    def _names_and_version(self) -> Self:
        for name in self.layers:
            if not LAYER_NAME.fullmatch(name):
                raise ValueError(f"layer name {name!r}: use lower-case letters, digits and underscores, a letter first")
        paths = [path for layer in self.layers.values() for path in layer.paths]
        if len(set(paths)) < len(paths):
            raise ValueError("two layers have the same path")
        if self.version != _version(self.world, self.layers):
            raise ValueError("version does not match the content; the file was edited or damaged")
        return self

    def layer(self, name: str) -> Layer:
        """Return the layer called ``name``; raises NotFoundError that lists the layers there are."""
        try:
            return self.layers[name]
        except KeyError:
            raise NotFoundError(f"no layer {name!r} in the dataset; it has {', '.join(self.layers)}") from None

    def to_json(self) -> bytes:
        """Return the bytes of ``manifest.json``: UTF-8, indented, same content same bytes."""
        return (self.model_dump_json(indent=1) + "\n").encode()


def _version(world: World, layers: dict[str, Layer]) -> str:
    content = {"world": world.model_dump(mode="json"), "layers": {name: layer.model_dump(mode="json") for name, layer in layers.items()}}
    return digest(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())


def digest(data: bytes | bytearray) -> str:
    """Return the BLAKE2b-128 digest of ``data`` as 32 hexadecimal digits: the digest used for blocks, indexes and versions."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def parse_manifest(data: bytes, where: str) -> Manifest:
    """Return the manifest in ``data``; raises InputError that names ``where`` and the first thing that is wrong."""
    try:
        raw = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not a manifest: {error}") from error
    if not isinstance(raw, dict) or raw.get("format") != "clipmap":
        raise InputError(f"{where}: not a clipmap manifest (no 'format': 'clipmap')")
    found = raw.get("format_version")
    if type(found) is not int:
        raise InputError(f"{where}: no whole number as 'format_version': not a clipmap manifest, or a damaged one")
    if found > FORMAT_VERSION:
        raise InputError(f"{where}: format version {found} is newer than this clipmap reads ({FORMAT_VERSION}); upgrade clipmap")
    try:
        return Manifest.model_validate(raw)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "manifest"
        raise InputError(f"{where}: {place}: {first['msg']}") from error
