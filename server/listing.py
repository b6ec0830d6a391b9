"""The catalogue as clients read it: what each dataset holds and where its manifest and blocks are."""

from typing import Literal
from urllib.parse import quote

from pydantic import BaseModel, Field

from schemas.manifest import Layer, LayerKind
from server.catalog import Catalog
from server.slots import PublishedDataset


class LayerSummary(BaseModel):
    """One layer of a dataset."""

    kind: LayerKind = Field(description="What a sample is")
    width: int = Field(description="Columns of level 0 [samples]")
    height: int = Field(description="Rows of level 0 [samples]")
    levels: int = Field(description="Number of levels; 0 is the finest, the last is one block")
    block: int = Field(description="Side of a block's core [samples]")
    codec: str = Field(description="Codec of the blocks with its parameters")
    media_type: str = Field(description="Media type of a block")
    stored: int = Field(description="Blocks that have bytes, on all levels")
    bytes: int = Field(description="Bytes of all blocks of all levels [bytes]")
    extent: tuple[float, float, float, float] = Field(description="(x min, y min, x max, y max) in world coordinates")
    blocks: str = Field(description="URI template of a block, relative to this document; the URL names the version")


class DatasetSummary(BaseModel):
    """One dataset in service."""

    name: str = Field(description="Name of the dataset, the first part of its URLs once percent-encoded")
    version: str = Field(description="Digest of the dataset's content; changes whenever any block changes")
    crs: str | None = Field(description="Coordinate reference system of world coordinates; null if unknown")
    manifest: str = Field(description="URL of the manifest, relative to this document")
    layers: dict[str, LayerSummary] = Field(description="Layers by name")


class DatasetProblem(BaseModel):
    """A dataset whose manifest cannot be read."""

    name: str = Field(description="Name of the dataset")
    detail: str = Field(description="What is wrong, and whether an earlier version stays in service")


class Catalogue(BaseModel):
    """All datasets, by name."""

    datasets: list[DatasetSummary] = Field(description="Datasets in service")
    problems: list[DatasetProblem] = Field(description="Datasets whose manifest cannot be read; empty if all is well")


class Health(BaseModel):
    """The service is up."""

    status: Literal["ok"] = Field(default="ok", description="Always 'ok': a service that is not well does not answer")
    version: str = Field(description="Version of clipmap")
    datasets: int = Field(description="Datasets in service when the catalogue was last looked at")


def catalogue(catalog: Catalog) -> Catalogue:
    """Return what is in service now."""
    published, problems = catalog.listing()
    return Catalogue(
        datasets=[_dataset_summary(dataset) for dataset in published],
        problems=[DatasetProblem(name=name, detail=detail) for name, detail in problems],
    )


def _dataset_summary(published: PublishedDataset) -> DatasetSummary:
    manifest = published.dataset.manifest
    # Relative, so that the links also hold behind a proxy that puts the service below a prefix.
    base = quote(published.name, safe="")
    return DatasetSummary(
        name=published.name,
        version=manifest.version,
        crs=manifest.world.crs,
        manifest=f"{base}/manifest.json?v={manifest.version}",
        layers={name: _layer_summary(layer, f"{base}/{name}", manifest.version) for name, layer in manifest.layers.items()},
    )


def _layer_summary(layer: Layer, base: str, version: str) -> LayerSummary:
    return LayerSummary(
        kind=layer.kind,
        width=layer.width,
        height=layer.height,
        levels=len(layer.levels),
        block=layer.block,
        codec=layer.codec,
        media_type=layer.media_type,
        stored=sum(level.stored for level in layer.levels),
        bytes=sum(level.stored_bytes for level in layer.levels),
        extent=layer.extent,
        blocks=f"{base}/{{level}}/{{x}}/{{y}}?v={version}",
    )
