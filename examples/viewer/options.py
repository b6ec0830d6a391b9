"""What a view is told: frozen, checked once, passed in."""

from dataclasses import dataclass
from typing import Literal

from schemas.errors import UsageError
from viewer.placement import check_grid

Choice = Literal["auto", "on", "off"]
TEXTURE_WINDOWS = (256, 512, 1024, 2048, 4096)


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Options of a picture; raises UsageError where they make no sense."""

    size: tuple[int, int] = (1280, 720)
    """Width and height of the picture [pixels]."""
    fov_deg: float = 45.0
    """Vertical field of view [degrees]."""
    exaggeration: float = 1.0
    """Factor on all heights."""
    sun_deg: tuple[float, float] | None = (315.0, 40.0)
    """Azimuth, clockwise from north, and elevation of the sun [degrees]; None: no shading."""
    haze_m: float | None = None
    """Distance at which haze hides 63 % [m]; None: no haze. Not drawn where nobody could see it."""
    curvature: Choice = "auto"
    """Whether distant ground sinks below the horizon; auto: where a dataset lies on the Earth and it can be seen."""
    grid: int = 255
    """Vertices along a side of a geometry level."""
    texture_window: int = 1024
    """Side of a texture window [texels]."""
    samples: int = 4
    """Coverage samples per pixel; 0: no antialiasing."""
    wireframe: bool = False
    """Draw the edges of the triangles only."""
    color_by_level: bool = False
    """Tint by geometry level."""
    cull: bool = True
    """Leave out patches that cannot be seen."""
    workers: int = 4
    """Threads that load and decode blocks."""
    height_layer: str | None = None
    """Name of the height layer; None: the dataset's only or first one."""
    imagery_layer: str | None = None
    """Name of the imagery layer; None: the dataset's only or first one."""

    def __post_init__(self) -> None:
        check_grid(self.grid)
        if self.texture_window not in TEXTURE_WINDOWS:
            raise UsageError(f"texture window {self.texture_window}: must be one of {', '.join(map(str, TEXTURE_WINDOWS))} texels")
        if not all(16 <= side <= 16384 for side in self.size):
            raise UsageError(f"size {self.size[0]}x{self.size[1]}: both sides must be from 16 to 16384 pixels")
        if not 1.0 <= self.fov_deg <= 150.0:
            raise UsageError(f"field of view {self.fov_deg:g}: must be from 1 to 150 degrees")
        if not 0.0 < self.exaggeration <= 1000.0:
            raise UsageError(f"exaggeration {self.exaggeration:g}: must be greater than 0 and at most 1000")
        if self.sun_deg is not None and not -90.0 <= self.sun_deg[1] <= 90.0:
            raise UsageError(f"sun elevation {self.sun_deg[1]:g}: must be from -90 to 90 degrees")
        if self.haze_m is not None and self.haze_m <= 0:
            raise UsageError(f"haze {self.haze_m:g}: must be a positive distance")
        if not 0 <= self.samples <= 64:
            raise UsageError(f"samples {self.samples}: must be from 0 to 64")
        if not 1 <= self.workers <= 64:
            raise UsageError(f"workers {self.workers}: must be from 1 to 64")
