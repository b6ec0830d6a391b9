"""A manifest of two layers with plausible content, for the tests of everything that reads manifests."""

from typing import Any, Final

from schemas.lattice import Lattice, Registration
from schemas.manifest import Filter, Layer, LayerKind, Level, Manifest, Source, Statistics, World, digest

GENERATOR: Final = "clipmap test"
WORLD: Final = World(crs="EPSG:32610", unit="metre")


def make_levels(lattice: Lattice) -> list[Level]:
    """Levels of ``lattice`` on which every block is stored."""
    levels = []
    for number in range(lattice.levels):
        (width, height), (columns, rows) = lattice.level_size(number), lattice.block_counts(number)
        count = columns * rows
        levels.append(
            Level(
                level=number,
                width=width,
                height=height,
                columns=columns,
                rows=rows,
                stored=count,
                blank=0,
                stored_bytes=1000 * count,
                availability="all",
                index=digest(b"index %d" % number),
            )
        )
    return levels


def make_layer(kind: LayerKind, width: int, height: int, block: int = 256, **changes: Any) -> Layer:
    """A layer of the given kind and size; ``changes`` replace fields."""
    is_height = kind == "height"
    registration: Registration = "point" if is_height else "area"
    fields: dict[str, Any] = {
        "kind": kind,
        "path": f"{kind}.0123abcd",
        "registration": registration,
        "width": width,
        "height": height,
        "block": block,
        "pad": 0,
        "channels": 1 if is_height else 3,
        "alpha": False,
        "dtype": "float32" if is_height else "uint8",
        "unit": "metre" if is_height else None,
        "codec": "lerc:0.01" if is_height else "jpeg:85",
        "suffix": "lerc" if is_height else "jpg",
        "media_type": "application/octet-stream" if is_height else "image/jpeg",
        "max_error": 0.01 if is_height else None,
        "transform": (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0),
        "ground_spacing_m": (30.0, 30.0),
        "filter": Filter(kernel="blackman-sinc", radius=6 if is_height else 3, edge="antisymmetric" if is_height else "mirror"),
        "source": Source(
            name="source.tif",
            format="tiff",
            width=width,
            height=height,
            channels=1 if is_height else 3,
            dtype="int16" if is_height else "uint8",
            file_bytes=width * height,
            nodata=-32768.0 if is_height else None,
            decode=None,
            scale=1.0,
            offset=0.0,
            placement="georeferenced",
        ),
        "statistics": Statistics(min=[-1.5], max=[4392.0], mean=[812.25], valid=width * height),
        "levels": make_levels(Lattice(width, height, block, registration)),
    }
    return Layer(**fields | changes)


def make_manifest() -> Manifest:
    """A dataset of imagery and of heights twice as coarse."""
    layers = {"imagery": make_layer("imagery", 1000, 700), "height": make_layer("height", 501, 351)}
    return Manifest.create(generator=GENERATOR, world=WORLD, layers=layers)
