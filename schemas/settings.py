"""Settings of a build and of a server: frozen, one line and unit per field, passed in, never global."""

from datetime import datetime
from pathlib import Path
from typing import Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_serializer, field_validator, model_validator

from schemas.light import Density, LeftOut
from schemas.manifest import Clamp, KernelName

HeightEncoding = Literal["terrarium", "terrain-rgb"]
MAX_SAMPLES: Final = 1 << 40
"""A million by a million, 2 TiB at 16 bits: more than any file a build can finish in days, far less than what a damaged header says."""


class Settings(BaseModel):
    """Base of all settings: immutable, no unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class BuildSettings(Settings):
    """What ``clipmap build`` is told; ``None`` means: chosen from the source."""

    layer: Literal["imagery", "height"] | None = Field(default=None, description="Kind of the layer; guessed from the source where safe")
    block: int = Field(default=256, description="Side of a block's core [samples], a power of two")
    pad: int = Field(default=0, ge=0, description="Stored border of a block, copied from its neighbours [samples]")
    codec: str | None = Field(default=None, description="Block codec, e.g. jpeg:85, png, webp:90, lerc:0.01")
    filter: KernelName = Field(default="blackman-sinc", description="Kernel that makes coarser levels")
    radius: int | None = Field(
        default=None, ge=1, le=16, description="Kernel radius [coarse samples]; 6 for heights, 3 for imagery, 1 for box and triangle"
    )
    clamp: Clamp = Field(default="none", description="'local' keeps coarse samples in the range of those under their taps: no ringing")
    linear_light: bool = Field(default=False, description="Filter sRGB imagery in linear light")
    fill: int = Field(default=0, ge=0, le=256, description="Fill voids of heights up to this many samples across")
    enhance: str | None = Field(default=None, description="Enhancement of imagery before the pyramid is built, wavelet or wavelet:GAIN")
    stretch: str | None = Field(
        default=None, description="Range of 16-bit imagery that becomes 0 to 255: CUT% at both ends of every colour channel, or MIN,MAX"
    )
    max_samples: int = Field(
        default=MAX_SAMPLES, ge=1, description="A source that declares more samples, over all channels, is refused before it is read"
    )
    mosaic: bool = Field(default=False, description="Put several georeferenced sources on one lattice, later ones on top")
    task: int | None = Field(
        default=None, ge=2, description="Side of a task [level-0 samples]; chosen by the size of the source; has no effect on the result"
    )
    workers: int | None = Field(
        default=None, ge=1, le=256, description="Threads; default: the processors there are; has no effect on the result"
    )
    bands: tuple[int, ...] | None = Field(default=None, min_length=1, max_length=4, description="Channels to take, from 1; all by default")
    nodata: float | None = Field(default=None, description="Value that marks a void in the source; NaN always does")
    decode: HeightEncoding | Literal["none"] | None = Field(
        default=None, description="How heights are hidden in the source's colour channels; 'none': they are not, whatever it looks like"
    )
    height_scale: float = Field(default=1.0, allow_inf_nan=False, description="Metres per unit of the source")
    height_offset: float = Field(default=0.0, allow_inf_nan=False, description="Metres added after scaling [m]")
    spacing: float | None = Field(
        default=None, ge=1e-6, le=1e7, description="Distance between samples of a source without georeference [m]"
    )
    overwrite: bool = Field(default=False, description="Replace the layer if the dataset has it already, or was left unfinished otherwise")
    update: bool = Field(default=False, description="Rebuild only what a changed source changes")
    records: bool = Field(default=True, description="Keep what update and repair need: records of tasks and samples between tiers")
    break_lock: bool = Field(default=False, description="Take over the lock of a build that has given no sign of life for minutes")

    @field_validator("bands")
    @classmethod
    def _counted_from_one(cls, bands: tuple[int, ...] | None) -> tuple[int, ...] | None:
        if bands is not None and min(bands) < 1:
            raise ValueError("channels are counted from 1")
        return bands

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        if self.height_scale == 0:
            raise ValueError("height_scale must not be 0")
        return self


class LightSettings(Settings):
    """What ``clipmap light`` is told: one sun, and what is simulated of it, of the sky and of the ground."""

    layer: str = Field(default="light", description="Name of the layer that is made")
    height: str = Field(default="height", description="Name of the layer of heights that light falls on")
    azimuth_deg: float | None = Field(default=None, allow_inf_nan=False, description="The sun's azimuth from true north [degrees]")
    elevation_deg: float | None = Field(default=None, ge=-90, le=90, description="The sun's elevation, without air [degrees]")
    when: datetime | None = Field(default=None, description="Time at which the sun is looked for, instead of its azimuth and elevation")
    density: Density = Field(default=1, description="Samples of light per sample of the heights along a row or a column")
    shadows: Literal["none", "hard", "certified", "soft"] = Field(
        default="hard", description="No cast shadows, those of a point, those without a wrong sample, or those of the sun's disc"
    )
    lines: int = Field(default=1, ge=1, le=64, description="Lines per sample of hard shadows: twice as many leave a quarter of the errors")
    radius_deg: float = Field(default=0.2666, gt=0, le=5, description="Angular radius of the sun's disc, for soft shadows [degrees]")
    sky: int = Field(default=0, ge=0, le=360, description="Azimuths in which the sky is looked for; 0: no light from the sky")
    share: float = Field(default=0.15, gt=0, le=10, description="Light of the open sky, relative to that of the sun on a facing surface")
    open_sky: bool = Field(default=False, description="Light of a sky of which only a sample's own slope hides any, if sky is 0")
    bounce: bool = Field(default=False, description="Light that the ground reflects once")
    albedo: float = Field(default=0.3, gt=0, lt=1, description="Share of its light that the ground reflects")
    curvature: bool = Field(default=True, description="The ground is curved")
    refraction: bool = Field(default=False, description="The air lifts the sun and bends its rays")
    codec: str = Field(default="png", description="Block codec: png, jpeg:Q, webp:Q, raw, exr:half or exr:float")
    bits: Literal[8, 16] = Field(default=8, description="Bits of a sample of png and raw")
    block: int | None = Field(default=None, description="Side of a block [samples]; that of the heights by default")
    task: int | None = Field(default=None, ge=2, description="Side of a task [level-0 samples]; has no effect on the result")
    workers: int | None = Field(default=None, ge=1, le=256, description="Threads; has no effect on the result")
    overwrite: bool = Field(default=False, description="Replace the layer if the dataset has it already")
    update: bool = Field(default=False, description="Rebuild only what changed heights change")
    records: bool = Field(default=True, description="Keep what update needs")
    left_out: tuple[LeftOut, ...] = Field(default=(), description="What a plan of effects has switched off; no effect on the light")
    break_lock: bool = Field(default=False, description="Take over the lock of a build that has given no sign of life for minutes")

    @field_serializer("when")
    def _as_text(self, when: datetime | None) -> str | None:
        return None if when is None else when.isoformat()

    @model_validator(mode="after")
    def _one_sun(self) -> Self:
        angles = (self.azimuth_deg, self.elevation_deg)
        if self.when is None and None in angles:
            raise ValueError("a sun needs azimuth and elevation, or a time")
        if self.when is not None and angles != (None, None):
            raise ValueError("a sun has azimuth and elevation, or a time, not both")
        return self


class NormalSettings(Settings):
    """What ``clipmap normals`` is told."""

    layer: str = Field(default="normal", description="Name of the layer that is made")
    height: str = Field(default="height", description="Name of the layer of heights whose normals are stored")
    density: Density = Field(default=1, description="Normals per sample of the heights along a row or a column")
    codec: str = Field(default="png", description="Block codec: png, raw, exr:half or exr:float")
    bits: Literal[8, 16] = Field(default=8, description="Bits of a sample of png and raw")
    block: int | None = Field(default=None, description="Side of a block [samples]; that of the heights by default")
    task: int | None = Field(default=None, ge=2, description="Side of a task [level-0 samples]; has no effect on the result")
    workers: int | None = Field(default=None, ge=1, le=256, description="Threads; has no effect on the result")
    overwrite: bool = Field(default=False, description="Replace the layer if the dataset has it already")
    update: bool = Field(default=False, description="Rebuild only what changed heights change")
    records: bool = Field(default=True, description="Keep what update needs")
    break_lock: bool = Field(default=False, description="Take over the lock of a build that has given no sign of life for minutes")


class ServerSettings(Settings):
    """What ``clipmap serve`` is told."""

    roots: tuple[str | Path, ...] = Field(min_length=1, description="Datasets, folders of datasets, or URLs of datasets")
    host: str = Field(default="127.0.0.1", description="Address to listen on")
    port: int = Field(default=8000, ge=0, le=65535, description="TCP port to listen on; 0 picks a free one")
