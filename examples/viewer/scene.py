"""A dataset opened for viewing: its layers, their pyramids, and where they lie. No OpenGL."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from schemas.manifest import Layer, LayerKind, Manifest
from schemas.region import Rect
from viewer.blocks import BlockKey, BlockLoader
from viewer.decode import Decoder, layer_decoder
from viewer.drawplan import MAX_LEVELS
from viewer.frame import Affine, LocalFrame, local_frame, texel_map
from viewer.options import ViewOptions
from viewer.pyramid import BlockHeights, FlatHeights, HeightPyramid, Heights, ImagePyramid, Pyramid
from viewer.source import BlockSource

WAIT_S: Final = 0.5
OVERVIEW_SIDE: Final = 512


@dataclass(frozen=True)
class Imagery:
    """The imagery layer and the map from level-0 height samples to its level-0 texels; normals are drawn as the ground's shading."""

    layer: Layer
    pyramid: Pyramid
    to_texels: Affine

    def facing(self, frame: LocalFrame) -> NDArray[np.float64]:
        """Return the unit vectors (east, north), as columns, of increasing columns and of decreasing rows, in which normals are told."""
        steps = frame.to_local.linear @ np.linalg.inv(self.to_texels.linear)
        return np.asarray(steps / np.hypot(*steps) * (1.0, -1.0), np.float64)


@dataclass(frozen=True)
class Scene:
    """What can be drawn of a dataset; heights are flat where it has none."""

    manifest: Manifest
    loader: BlockLoader
    heights: HeightPyramid
    has_heights: bool
    frame: LocalFrame
    imagery: Imagery | None
    z_range_m: tuple[float, float]

    def is_loaded(self, key: BlockKey) -> bool:
        """Whether a block is in the cache; asking counts as using it."""
        return self.loader.get(key) is not None

    def overview(self) -> tuple[int, Heights]:
        """Return the finest level of at most ``OVERVIEW_SIDE`` samples that is loaded, and all heights of it."""
        level = self.heights.levels - 1
        while level and self._is_small(level - 1) and not self._missing(level - 1, self.heights.extent(level - 1)):
            level -= 1
        heights = self.heights.heights(level, self.heights.extent(level))
        if heights is None:
            raise RuntimeError("the coarsest blocks are not loaded")
        return level, heights

    def ground_m(self, x_m: float, y_m: float) -> float | None:
        """Return the height of the ground at local metres, from the finest level loaded there [m]; None over a void or outside."""
        column, row = self.frame.sample_at(x_m, y_m)
        for level in range(self.heights.levels):
            x, y = column * 0.5**level, row * 0.5**level
            corner = Rect(math.floor(x), math.floor(y), math.floor(x) + 2, math.floor(y) + 2)
            heights = self.heights.heights(level, corner)
            if heights is not None:
                fx, fy = x - corner.x0, y - corner.y0
                weights = np.outer((1 - fy, fy), (1 - fx, fx)) * heights[1]
                # Beside a void or the edge the valid samples decide.
                return float((weights * heights[0]).sum() / weights.sum()) if weights.sum() > 1e-6 else None
        return None

    def _is_small(self, level: int) -> bool:
        extent = self.heights.extent(level)
        return max(extent.width, extent.height) <= OVERVIEW_SIDE

    def load_coarsest(self) -> None:
        """Load the coarsest block of every layer, without which nothing can be drawn; raises what loading raises."""
        wanted = self._missing(self.heights.levels - 1, self.heights.extent(self.heights.levels - 1))
        if self.imagery is not None:
            last = self.imagery.pyramid.levels - 1
            wanted += [key for key in self.imagery.pyramid.needs(last, self.imagery.pyramid.extent(last)) if not self.is_loaded(key)]
        load_all(self.loader, lambda: [key for key in wanted if not self.is_loaded(key)])

    def close(self) -> None:
        """Stop the workers."""
        self.loader.close()

    def _missing(self, level: int, rect: Rect) -> list[BlockKey]:
        return [key for key in self.heights.needs(level, rect) if not self.is_loaded(key)]


def load_all(loader: BlockLoader, wanted: Callable[[], list[BlockKey]]) -> None:
    """Load until ``wanted`` asks for nothing; raises the first failure."""
    while keys := wanted():
        loader.request(keys)
        loader.wait(WAIT_S)
        for error in loader.failures.values():
            raise error


def open_scene(source: BlockSource, options: ViewOptions) -> Scene:
    """Open what ``options`` ask for of a dataset.

    Raises UsageError if the dataset cannot be drawn that way, NotFoundError if it lacks a layer that was named.
    """
    manifest = source.manifest
    height = _choose(manifest, "height", options.height_layer)
    image = _choose(manifest, "imagery", options.imagery_layer)
    chosen = dict(part for part in (height, image) if part is not None)
    if height is not None and height[1].registration != "point":
        raise UsageError(f"layer {height[0]!r} is area-registered; only point-registered heights can be drawn, rebuild the layer")
    if image is not None and image[1].block > options.texture_window:
        raise UsageError(f"layer {image[0]!r} has blocks of {image[1].block} samples: --texture-window must be at least that")
    frame = local_frame((height or _any(image))[1], manifest.world)
    decoders: Mapping[str, Decoder] = {name: layer_decoder(layer) for name, layer in chosen.items()}
    loader = BlockLoader(source.read, decoders, options.workers)
    heights = _heights(height, image, loader, frame, options.grid // 4)
    if heights.levels > MAX_LEVELS:
        loader.close()
        raise UsageError(f"the dataset needs {heights.levels} levels of a grid of {options.grid}; at most {MAX_LEVELS} can be drawn")
    imagery = None
    if image is not None:
        imagery = Imagery(image[1], ImagePyramid(*image, loader.get), texel_map(frame, image[1]))
    return Scene(manifest, loader, heights, height is not None, frame, imagery, _z_range(height))


_Named = tuple[str, Layer]


def _any(named: _Named | None) -> _Named:
    if named is None:
        raise UsageError("the dataset has neither heights nor imagery to draw")
    return named


def _choose(manifest: Manifest, kind: LayerKind, name: str | None) -> _Named | None:
    if name is not None:
        layer = manifest.layer(name)
        is_drawn_alike = kind == "imagery" and layer.kind in ("light", "normal")
        if layer.kind != kind and not is_drawn_alike:
            raise UsageError(f"layer {name!r} is of kind {layer.kind}, not {kind}")
        return name, layer
    names = [known for known, layer in manifest.layers.items() if layer.kind == kind]
    if not names:
        return None
    found = kind if kind in names else names[0]
    return found, manifest.layers[found]


def _heights(height: _Named | None, image: _Named | None, loader: BlockLoader, frame: LocalFrame, coarsest: int) -> HeightPyramid:
    if height is None:
        layer = _any(image)[1]
        # Samples of the flat ground lie on the corners of area texels, so that it covers the imagery to its edges.
        corner = 1 if layer.registration == "area" else 0
        return FlatHeights(layer.width + corner, layer.height + corner, coarsest)
    gradient = np.asarray(np.linalg.inv(frame.to_local.linear).T, np.float64)
    return BlockHeights(*height, loader.get, gradient, coarsest)


def _z_range(height: _Named | None) -> tuple[float, float]:
    """Return the smallest and the largest height of level 0."""
    if height is None or not height[1].statistics.min:
        return 0.0, 0.0
    low, high = height[1].statistics.min[0], height[1].statistics.max[0]
    return low, high
