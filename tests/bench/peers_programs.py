"""The programs that are compared, and the options with which each does the work of the others as nearly as it can."""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

Source = Literal["rgb", "height"]
CLIPMAP: Final = str(Path(sys.executable).with_name("clipmap"))
VIPS_LAYOUT: Final = ("--tile-size", "256", "--overlap", "0", "--depth", "onetile")
COG: Final = "gdal_translate -q -of COG -co BLOCKSIZE=256 -co NUM_THREADS=ALL_CPUS -co BIGTIFF=IF_SAFER {source} {output}/cog.tif"
OVERVIEWS: Final = (
    "gdaladdo -q -ro -r average --config COMPRESS_OVERVIEW JPEG --config JPEG_QUALITY_OVERVIEW 85 --config GDAL_NUM_THREADS ALL_CPUS "
    "--config PHOTOMETRIC_OVERVIEW YCBCR --config INTERLEAVE_OVERVIEW PIXEL --config GDAL_TIFF_OVR_BLOCKSIZE 256 {output}/link.tif"
)


@dataclass(frozen=True, slots=True)
class Program:
    """A command with ``{source}`` and ``{output}``, a folder that exists; ``runs`` is fewer than asked where it is very slow."""

    case: str
    name: str
    filter: str
    command: tuple[str, ...]
    runs: int | None = None
    remark: str = ""

    @property
    def installed(self) -> bool:
        """Whether the program is there."""
        return shutil.which(self.command[0]) is not None

    def line(self, source: Path, output: Path) -> list[str]:
        """Return the command for ``source`` and the folder ``output``."""
        return [part.format(source=source, output=output) for part in self.command]


def _clipmap(layer: str, codec: str, *options: str) -> tuple[str, ...]:
    return (CLIPMAP, "build", "{source}", "-o", "{output}/dataset", "--json", "--layer", layer, "--codec", codec, *options)


def _cog(*options: str) -> tuple[str, ...]:
    return (*COG.split(), *(part for option in options for part in ("-co", option)))


def _vips(suffix: str) -> tuple[str, ...]:
    return ("vips", "dzsave", "{source}", "{output}/vips", "--suffix", suffix, *VIPS_LAYOUT)


def _maketx(*options: str) -> tuple[str, ...]:
    return ("maketx", "{source}", "-o", "{output}/maketx.tx", "--tile", "256", "256", *options)


def _jpeg(levels: int) -> list[Program]:
    case = "RGB to JPEG, quality 85"
    factors = tuple(str(1 << level) for level in range(1, levels))
    return [
        Program(case, "clipmap", "blackman-sinc 3, 12 taps", _clipmap("imagery", "jpeg:85")),
        Program(case, "vips dzsave", "box, 2 taps", _vips(".jpg[Q=85]")),
        Program(case, "clipmap --filter box", "box, 2 taps", _clipmap("imagery", "jpeg:85", "--filter", "box")),
        Program(case, "GDAL COG, average", "box, 2 taps", _cog("COMPRESS=JPEG", "QUALITY=85", "RESAMPLING=AVERAGE")),
        Program(case, "GDAL COG, lanczos", "lanczos 3, 12 taps", _cog("COMPRESS=JPEG", "QUALITY=85", "RESAMPLING=LANCZOS")),
        Program(
            case,
            "gdaladdo",
            "box, 2 taps",
            (*OVERVIEWS.split(), *factors),
            remark="coarse levels only, a quarter of all blocks",
        ),
        Program(case, "maketx", "box, 2 taps", _maketx("--compression", "jpeg:85"), runs=3),
    ]


def _png() -> list[Program]:
    case = "RGB to PNG"
    tiles = ("gdal2tiles.py", "-q", "-p", "raster", "-r", "average", "-w", "none", "--processes=2", "{source}", "{output}/tiles")
    return [
        Program(case, "clipmap", "blackman-sinc 3, 12 taps", _clipmap("imagery", "png")),
        Program(case, "vips dzsave", "box, 2 taps", _vips(".png")),
        Program(case, "gdal2tiles.py", "box, 2 taps", tiles, runs=2, remark="adds an alpha channel"),
    ]


def _heights() -> list[Program]:
    case = "float32 heights, error at most 0.1 m"
    error, lossless = ("COMPRESS=LERC", "MAX_Z_ERROR=0.1"), ("COMPRESS=ZSTD", "PREDICTOR=YES")
    return [
        Program(case, "clipmap lerc:0.1", "blackman-sinc 6, 24 taps", _clipmap("height", "lerc:0.1")),
        Program(case, "GDAL COG LERC, lanczos", "lanczos 3, 12 taps", _cog(*error, "RESAMPLING=LANCZOS")),
        Program(case, "GDAL COG LERC, average", "box, 2 taps", _cog(*error, "RESAMPLING=AVERAGE")),
        Program(case, "clipmap lerc:0.1 --filter box", "box, 2 taps", _clipmap("height", "lerc:0.1", "--filter", "box")),
        Program(case, "clipmap png16", "blackman-sinc 6, 24 taps", _clipmap("height", "png16:0.1,-1000"), remark="steps of 0.1 m"),
        Program(case, "clipmap exr:float", "blackman-sinc 6, 24 taps", _clipmap("height", "exr:float"), runs=3, remark="lossless"),
        Program(case, "GDAL COG ZSTD, lanczos", "lanczos 3, 12 taps", _cog(*lossless, "RESAMPLING=LANCZOS"), remark="lossless"),
    ]


def programs(side: int) -> dict[Source, list[Program]]:
    """Return what is run on each source of ``side`` samples a side, in the order of a round."""
    levels = (side // 256).bit_length()
    return {"rgb": _jpeg(levels) + _png(), "height": _heights()}


def versions() -> dict[str, str]:
    """Return what each program says of its version, or that it is missing."""
    asked = {"clipmap": [CLIPMAP, "--version"], "vips": ["vips", "--version"], "gdal": ["gdal_translate", "--version"]}
    asked |= {"gdal2tiles.py": ["gdal2tiles.py", "--version"], "maketx": ["maketx", "--version"]}
    found = {}
    for name, command in asked.items():
        if shutil.which(command[0]) is None:
            found[name] = "missing"
            continue
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
        found[name] = (answer.stdout or answer.stderr).strip().partition("\n")[0]
    return found
