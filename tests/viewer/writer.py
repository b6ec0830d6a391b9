"""A tiny dataset writer for the viewer's tests: levels by plain averaging or decimation, blocks by any codec."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.blockindex import BLANK, BlockRecord, pack_record
from schemas.lattice import Registration
from schemas.manifest import (
    MANIFEST_NAME,
    Filter,
    Layer,
    LayerKind,
    Level,
    Manifest,
    SampleType,
    Source,
    Statistics,
    Transform,
    World,
    digest,
    pack_bitmap,
)
from tiler.codecs import BlockFormat, open_codec


@dataclass(frozen=True)
class LayerSpec:
    """What to write: ``samples`` (h, w) heights or (h, w, c) imagery, ``valid`` (h, w) for heights with voids."""

    name: str
    kind: LayerKind
    samples: NDArray[Any]
    transform: Transform
    valid: NDArray[np.bool_] | None = None
    block: int = 16
    pad: int = 0
    codec: str = "raw"
    alpha: bool = False
    registration: Registration | None = None
    ground_spacing_m: tuple[float, float] | None = None


def coarser(samples: NDArray[Any], registration: str) -> NDArray[Any]:
    """The next level: every second sample (point), or the mean of 2 x 2 cells with the edge repeated (area)."""
    if registration == "point":
        return samples[::2, ::2]
    height, width = samples.shape[:2]
    padded = np.pad(samples, ((0, height % 2), (0, width % 2), *((0, 0),) * (samples.ndim - 2)), mode="edge").astype(np.float64)
    mean = (padded[0::2, 0::2] + padded[1::2, 0::2] + padded[0::2, 1::2] + padded[1::2, 1::2]) / 4
    return (np.rint(mean) if samples.dtype.kind == "u" else mean).astype(samples.dtype)


def build_layer(spec: LayerSpec) -> tuple[Layer, dict[str, bytes]]:
    """Return the layer's part of the manifest and its files by key."""
    registration: Registration = spec.registration or ("point" if spec.kind == "height" else "area")
    samples = spec.samples if spec.samples.ndim == 3 else spec.samples[..., None]
    samples = samples.astype(np.float32) if spec.kind == "height" else samples
    height, width, channels = samples.shape
    dtypes: dict[str, SampleType] = {"uint8": "uint8", "uint16": "uint16", "float32": "float32"}
    form = BlockFormat(spec.kind, spec.block + 2 * spec.pad, channels, dtypes[samples.dtype.name], spec.alpha)
    codec = open_codec(spec.codec, form)
    valid = np.ones((height, width), np.bool_) if spec.valid is None else spec.valid
    colours = samples[..., :-1] if spec.alpha else samples
    held = colours[valid & np.isfinite(colours).all(axis=-1)]
    draft = Layer(
        kind=spec.kind,
        path=spec.name,
        registration=registration,
        width=width,
        height=height,
        block=spec.block,
        pad=spec.pad,
        channels=channels,
        alpha=spec.alpha,
        dtype=form.dtype,
        unit="metre" if spec.kind == "height" else None,
        codec=codec.spec,
        suffix=codec.suffix,
        media_type=codec.media_type,
        max_error=codec.max_error,
        transform=spec.transform,
        ground_spacing_m=spec.ground_spacing_m,
        filter=Filter(kernel="blackman-sinc", radius=3, edge="mirror"),
        source=Source(
            name="test",
            format="array",
            width=width,
            height=height,
            channels=channels,
            dtype=str(samples.dtype),
            file_bytes=0,
            nodata=None,
            decode=None,
            scale=1.0,
            offset=0.0,
            placement="spacing",
        ),
        statistics=Statistics(
            min=[float(v) for v in held.min(axis=0)] if held.size else [],
            max=[float(v) for v in held.max(axis=0)] if held.size else [],
            mean=[float(v) for v in held.mean(axis=0)] if held.size else [],
            valid=int(valid.sum()),
        ),
        levels=_blank_levels(width, height, spec.block, registration),
    )
    files: dict[str, bytes] = {}
    levels = []
    for level in range(len(draft.levels)):
        levels.append(_write_level(spec, draft, level, samples, valid, files))
        samples, valid = coarser(samples, registration), coarser(valid, "point")
    return draft.model_copy(update={"levels": levels}), files


def _blank_levels(width: int, height: int, block: int, registration: Registration) -> list[Level]:
    from schemas.lattice import Lattice

    lattice = Lattice(width, height, block, registration)
    levels = []
    for number in range(lattice.levels):
        (w, h), (columns, rows) = lattice.level_size(number), lattice.block_counts(number)
        levels.append(
            Level(
                level=number,
                width=w,
                height=h,
                columns=columns,
                rows=rows,
                stored=0,
                blank=0,
                stored_bytes=0,
                availability="all",
                index="0" * 32,
            )
        )
    return levels


def _write_level(
    spec: LayerSpec, layer: Layer, level: int, samples: NDArray[Any], valid: NDArray[np.bool_], files: dict[str, bytes]
) -> Level:
    lattice = layer.lattice
    form = BlockFormat(layer.kind, lattice.stored_side, layer.channels, layer.dtype, layer.alpha)
    codec = open_codec(layer.codec, form)
    height, width = samples.shape[:2]
    assert lattice.level_size(level) == (width, height)
    records, bitmap, stored_bytes = [], bytearray(-(-lattice.block_counts(level)[0] * lattice.block_counts(level)[1] // 8)), 0
    for number, address in enumerate(lattice.addresses(level)):
        core = lattice.core(address).grown(lattice.pad)
        rows = np.clip(np.arange(core.y0, core.y1), 0, height - 1)
        columns = np.clip(np.arange(core.x0, core.x1), 0, width - 1)
        block, mask = samples[np.ix_(rows, columns)], valid[np.ix_(rows, columns)]
        if not mask.any() or (layer.alpha and not block[..., -1].any()):
            records.append(BLANK)
            continue
        data = codec.encode(block, mask if layer.kind == "height" and not mask.all() else None)
        files[layer.block_key(spec.name, address)] = data
        records.append(BlockRecord(digest(data), len(data), int(mask.sum()), 0.0, 0.0))
        bitmap[number >> 3] |= 1 << (number & 7)
        stored_bytes += len(data)
    index = b"".join(pack_record(record) for record in records)
    files[layer.index_key(level)] = index
    stored = sum(not record.blank for record in records)
    return layer.levels[level].model_copy(
        update={
            "stored": stored,
            "blank": len(records) - stored,
            "stored_bytes": stored_bytes,
            "availability": pack_bitmap(bytes(bitmap), len(records)),
            "index": digest(index),
        }
    )


def write_dataset(root: Path, specs: Sequence[LayerSpec], world: World | None = None) -> Manifest:
    """Write a dataset of the given layers to ``root`` and return its manifest."""
    layers = {}
    for spec in specs:
        layer, files = build_layer(spec)
        layers[spec.name] = layer
        for key, data in files.items():
            path = root / key
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    manifest = Manifest.create(generator="test", world=world or World(crs=None, unit="metre"), layers=layers)
    (root / MANIFEST_NAME).write_bytes(manifest.to_json())
    return manifest


class ProceduralSource:
    """Heights from a function of level-0 samples x, y and the level, as raw blocks made on demand: lattices far too large to write."""

    def __init__(self, side: int, block: int, height: Any, spacing: float = 1.0) -> None:
        tiny = LayerSpec("height", "height", np.zeros((2, 2), np.float32), (spacing, 0.0, 0.0, 0.0, -spacing, 0.0), block=block)
        layer, _ = build_layer(replace(tiny))
        layer = layer.model_copy(update={"width": side, "height": side, "levels": _blank_levels(side, side, block, "point")})
        layer = layer.model_copy(update={"statistics": Statistics(min=[-1000.0], max=[1000.0], mean=[0.0], valid=side * side)})
        self.manifest = Manifest.create(generator="test", world=World(crs=None, unit="metre"), layers={"height": layer})
        self.location = "procedural"
        self._height = height
        self._layer = layer

    def read(self, layer: str, address: BlockAddress) -> bytes | None:
        core = self._layer.lattice.core(address)
        y, x = np.mgrid[core.y0 : core.y1, core.x0 : core.x1].astype(np.int64) << address.level
        z = np.asarray(self._height(x, y, address.level), np.float32)
        return z.astype("<f4").tobytes()

    def close(self) -> None:
        pass
