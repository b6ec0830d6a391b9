"""What ``clipmap inspect`` says of a dataset, a layer, a level, a block or a place: typed, so that ``--json`` keeps its word.

``docs/reports.schema.json`` is generated from these models and those of ``schemas/findings.py``.
"""

from pydantic import Field

from schemas.light import Light, Normals
from schemas.manifest import Digest, Filter, LayerKind, SampleType, Source, Statistics, Transform
from schemas.model import Model

Extent = tuple[float, float, float, float]


class LevelSummary(Model):
    """One line of a layer's table of levels."""

    level: int = Field(description="0 is the finest")
    width: int = Field(description="Columns [samples]")
    height: int = Field(description="Rows [samples]")
    columns: int = Field(description="Columns of blocks")
    rows: int = Field(description="Rows of blocks")
    stored: int = Field(description="Blocks that have bytes")
    blank: int = Field(description="Blocks without a valid sample")
    stored_bytes: int = Field(description="Bytes of all stored blocks [bytes]")
    ground_spacing_m: tuple[float, float] | None = Field(description="Ground distance between samples at the layer's centre [m]")


class Footprint(Model):
    """A layer on the WGS 84 ellipsoid; if it crosses the antimeridian, west is greater than east."""

    west_deg: float = Field(description="Western longitude, -180 to 180 [degrees]")
    south_deg: float = Field(description="Southern latitude [degrees]")
    east_deg: float = Field(description="Eastern longitude, -180 to 180 [degrees]")
    north_deg: float = Field(description="Northern latitude [degrees]")
    crosses_antimeridian: bool
    contains_pole: bool
    area_m2: float = Field(description="Area on the ellipsoid [square metres]")
    row_spacing_m: tuple[float, float] = Field(description="Smallest and largest ground distance of neighbours in a row, level 0 [m]")
    column_spacing_m: tuple[float, float] = Field(description="Smallest and largest ground distance of neighbours in a column, level 0 [m]")


class LayerFacts(Model):
    """A layer: the manifest's entry, and what follows from it."""

    layer: str = Field(description="Name of the layer")
    kind: LayerKind
    width: int = Field(description="Columns of level 0 [samples]")
    height: int = Field(description="Rows of level 0 [samples]")
    patches: int = Field(description="Updates whose blocks lie under paths of their own")
    registration: str
    channels: int
    alpha: bool
    dtype: SampleType
    sample_unit: str | None = Field(description="Unit of a sample; null for colour")
    block: int = Field(description="Side of a block's core [samples]")
    pad: int = Field(description="Stored border of a block [samples]")
    codec: str
    max_error: float | None = Field(description="Bound on the error of a decoded sample [unit of a sample]; null if not bounded")
    filter: Filter
    fill: int = Field(description="Voids up to this many samples across were filled")
    enhance: str | None = Field(description="How samples were enhanced before the pyramid was built")
    light: Light | None = Field(description="What light a layer of light holds; null for others")
    normals: Normals | None = Field(description="What normals a layer of normals holds; null for others")
    transform: Transform = Field(description="From level-0 sample coordinates to world coordinates")
    extent: Extent = Field(description="x min, y min, x max, y max [world units]")
    ground_spacing_m: tuple[float, float] | None = Field(description="Ground distance between samples of level 0 at the centre [m]")
    footprint: Footprint | None = Field(description="Place and size on the Earth; null without a coordinate reference system")
    source: Source
    statistics: Statistics
    valid_share: float = Field(description="Share of level-0 samples that are valid, from 0 to 1")
    blocks_stored: int
    blocks_blank: int
    stored_bytes: int = Field(description="Bytes of all stored blocks [bytes]")
    levels: list[LevelSummary]


class DatasetFacts(Model):
    """A dataset and all its layers."""

    dataset: str = Field(description="Where the dataset is")
    version: Digest
    generator: str
    format_version: int
    crs: str | None
    unit: str = Field(description="Unit of world coordinates")
    layers: list[LayerFacts]


class CoverageMap(Model):
    """Where a level has valid samples, scaled down to a grid of cells."""

    blocks_per_cell: int = Field(description="A cell stands for so many blocks along each axis")
    valid_share: list[list[float]] = Field(description="Per cell, rows from the top: share of its samples that are valid, from 0 to 1")


class LevelFacts(LevelSummary):
    """A level with the range of its values and a map of where they are."""

    dataset: str
    layer: str
    row_spacing_m: tuple[float, float] | None = Field(description="Smallest and largest ground distance of neighbours in a row [m]")
    column_spacing_m: tuple[float, float] | None = Field(description="Smallest and largest ground distance of neighbours in a column [m]")
    min: float | None = Field(description="Smallest valid sample over all colour channels; null if none is valid")
    max: float | None
    valid: int = Field(description="Valid samples")
    block_bytes_min: int | None = Field(description="Size of the smallest stored block [bytes]")
    block_bytes_max: int | None = Field(description="Size of the largest stored block [bytes]")
    coverage: CoverageMap


class BlockFacts(Model):
    """A block: where it is, what the index says of it, and what its bytes decode to."""

    dataset: str
    layer: str
    level: int
    x: int
    y: int
    quadcode: str
    name: str
    key: str = Field(description="Where the bytes are in the store")
    samples: tuple[int, int, int, int] = Field(description="Core on its level: x0, y0, x1, y1, half-open [samples]")
    extent: Extent = Field(description="x min, y min, x max, y max [world units]")
    blank: bool
    stored_bytes: int
    digest: str | None
    intact: bool = Field(description="Whether the stored bytes fit the index's digest, and can be decoded")
    valid: int = Field(description="Valid samples of the core, by the index")
    min: float | None = Field(description="Smallest valid sample before encoding, by the index")
    max: float | None
    decoded_min: list[float] | None = Field(description="Per colour channel, of the decoded core; null if there is nothing to decode")
    decoded_max: list[float] | None
    decoded_mean: list[float] | None
    parent: str | None
    children: list[str]
    neighbours: list[str]


class PointSample(Model):
    """What one level of a layer holds at a place."""

    level: int
    sample: tuple[int, int] = Field(description="Column and row on the level [samples]")
    block: str = Field(description="Address, level/x/y")
    name: str = Field(description="Name of the block")
    value: list[float] | None = Field(description="Decoded sample, one number per channel; null if void")


class LayerPoint(Model):
    """What a layer holds at a place, level by level, the finest first; no levels if the place lies outside the layer."""

    layer: str
    unit: str | None = Field(description="Unit of the values; null for colour")
    position: tuple[float, float] = Field(description="Column and row in level-0 sample coordinates")
    levels: list[PointSample]


class PointFacts(Model):
    """What the layers of a dataset hold at a place."""

    dataset: str
    longitude_latitude: tuple[float, float] | None = Field(description="WGS 84 [degree]; null if the dataset has no reference system")
    world: tuple[float, float] = Field(description="World coordinates x, y [world units]")
    crs: str | None
    layers: list[LayerPoint]
