"""Stacks of toroidal textures: the only place that writes samples to the GPU."""

from dataclasses import dataclass
from typing import Any, Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from schemas.errors import UsageError
from viewer.pyramid import Planes
from viewer.torus import TorusRect


@dataclass(frozen=True, slots=True)
class PlaneFormat:
    """One texture of a stack: its channels, numpy type, and whether it is interpolated."""

    channels: int
    dtype: str
    smooth: bool


HEIGHT_PLANES: Final = (PlaneFormat(2, "f4", smooth=False), PlaneFormat(2, "f2", smooth=True))
"""Height and validity, fetched one by one; slopes, interpolated."""
IMAGE_PLANES: Final = (PlaneFormat(4, "u1", smooth=True),)
"""RGBA8: three-channel uploads are an order of magnitude slower."""


class TextureStack:
    """Texture arrays of ``levels`` layers of ``side`` x ``side`` samples, one per plane, that wrap around.

    Raises UsageError if the machine's textures are smaller.
    """

    def __init__(self, context: moderngl.Context, side: int, levels: int, planes: tuple[PlaneFormat, ...]) -> None:
        largest, layers = int(context.info["GL_MAX_TEXTURE_SIZE"]), int(context.info["GL_MAX_ARRAY_TEXTURE_LAYERS"])
        if side > largest or levels > layers:
            raise UsageError(f"windows of {side} samples on {levels} levels exceed this machine's textures ({largest}, {layers} layers)")
        self._side = side
        self._levels = levels
        self._planes = planes
        self.textures = [self._texture(context, plane) for plane in planes]
        self.written_bytes = 0

    def _texture(self, context: moderngl.Context, plane: PlaneFormat) -> moderngl.TextureArray:
        dtype = "f1" if plane.dtype == "u1" else plane.dtype
        texture = context.texture_array((self._side, self._side, self._levels), plane.channels, dtype=dtype)
        filtering = moderngl.LINEAR if plane.smooth else moderngl.NEAREST
        texture.filter = (filtering, filtering)
        texture.repeat_x = texture.repeat_y = True
        return texture

    def write(self, level: int, rect: TorusRect, planes: Planes) -> None:
        """Put ``planes``, arrays (height, width, channels) of ``rect.source``, into the slots of ``rect``.

        OpenGL takes a rectangle outside the texture, or too little data, without a word; hence the checks.
        """
        x, y, width, height = rect.slots
        if not (0 <= level < self._levels and 0 <= x <= x + width <= self._side and 0 <= y <= y + height <= self._side):
            raise ValueError(f"slots {rect.slots} of level {level} lie outside a stack of {self._levels} times {self._side} samples")
        for plane, texture, samples in zip(self._planes, self.textures, planes, strict=True):
            if samples.shape != (height, width, plane.channels) or samples.dtype != np.dtype(plane.dtype):
                raise ValueError(f"{samples.shape} {samples.dtype} do not fill {width} x {height} slots of {plane}")
            data = rect.arrange(samples)
            texture.write(data, viewport=(x, y, level, width, height, 1))
            self.written_bytes += data.nbytes

    def read(self, plane: int) -> NDArray[Any]:
        """Return what a plane holds, (levels, side, side, channels) in the order of the slots."""
        shape = (self._levels, self._side, self._side, self._planes[plane].channels)
        return np.frombuffer(self.textures[plane].read(), self._planes[plane].dtype).reshape(shape)

    def release(self) -> None:
        """Free the textures."""
        for texture in self.textures:
            texture.release()
