"""The programs that are compared, and the options with which each does the work of the others as nearly as it can."""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.bench.inputs import LAYOUTS, PLAIN, Source

CLIPMAP: Final = str(Path(sys.executable).with_name("clipmap"))
VIPS_LAYOUT: Final = ("--tile-size", "256", "--overlap", "0", "--depth", "onetile")
COG: Final = "gdal_translate -q -of COG -co BLOCKSIZE=256 -co NUM_THREADS=ALL_CPUS -co BIGTIFF=IF_SAFER {source} {output}/cog.tif"
COG_JPEG: Final = ("COMPRESS=JPEG", "QUALITY=85")
OVERVIEWS: Final = (
    "gdaladdo -q -ro -r average --config COMPRESS_OVERVIEW JPEG --config JPEG_QUALITY_OVERVIEW 85 --config GDAL_NUM_THREADS ALL_CPUS "
    "--config PHOTOMETRIC_OVERVIEW YCBCR --config INTERLEAVE_OVERVIEW PIXEL --config GDAL_TIFF_OVR_BLOCKSIZE 256 {output}/link.tif"
)
GDAL2TILES: Final = "gdal2tiles.py -q -p raster -r average -w none --processes={processors} {source} {output}/tiles"
BOX: Final = "box, 2 taps"
SINC_3: Final = "blackman-sinc 3, 12 taps"
SINC_6: Final = "blackman-sinc 6, 23 taps"
LANCZOS: Final = "lanczos 3, 12 taps"


@dataclass(frozen=True, slots=True)
class Program:
    """A command with ``{source}``, ``{output}``, a folder that exists, and ``{processors}``.

    ``runs`` is fewer than asked where it is very slow; ``against`` names the program of its case that it is compared with, where
    that is not the first one.
    """

    name: str
    filter: str
    command: tuple[str, ...]
    source: Source
    runs: int | None = None
    remark: str = ""
    against: str | None = None

    @property
    def installed(self) -> bool:
        """Whether the program is there."""
        return shutil.which(self.command[0]) is not None

    def line(self, source: Path, output: Path, processors: int) -> list[str]:
        """Return the command for ``source`` and the folder ``output``."""
        return [part.format(source=source, output=output, processors=processors) for part in self.command]


@dataclass(frozen=True, slots=True)
class Case:
    """Programs that are measured in turn; ``runs`` is the most rounds that are worth their time."""

    key: str
    title: str
    programs: tuple[Program, ...]
    runs: int | None = None


def clipmap(layer: str, codec: str, *options: str) -> tuple[str, ...]:
    """Return the command that builds one layer and prints its report as JSON."""
    return (CLIPMAP, "build", "{source}", "-o", "{output}/dataset", "--json", "--layer", layer, "--codec", codec, *options)


def cog(*options: str) -> tuple[str, ...]:
    """Return the command that makes a COG with these creation options."""
    return (*COG.split(), *(part for option in options for part in ("-co", option)))


def vips(suffix: str) -> tuple[str, ...]:
    """Return the command that cuts a pyramid into files of this suffix, which holds the encoder's options."""
    return ("vips", "dzsave", "{source}", "{output}/vips", "--suffix", suffix, *VIPS_LAYOUT)


def _maketx(*options: str) -> tuple[str, ...]:
    return ("maketx", "{source}", "-o", "{output}/maketx.tx", "--tile", "256", "256", *options)


def _jpeg(side: int) -> Case:
    source = Source("rgb", side)
    factors = tuple(str(1 << level) for level in range(1, (side // 256).bit_length()))
    webp = (*GDAL2TILES.split(), "--tiledriver=WEBP", "--webp-quality=85")
    return Case(
        "jpeg",
        "RGB to JPEG, quality 85",
        (
            Program("clipmap", SINC_3, clipmap("imagery", "jpeg:85"), source),
            Program("vips dzsave", BOX, vips(".jpg[Q=85]"), source),
            Program("clipmap --filter box", BOX, clipmap("imagery", "jpeg:85", "--filter", "box"), source),
            Program("GDAL COG, average", BOX, cog(*COG_JPEG, "RESAMPLING=AVERAGE"), source),
            Program("GDAL COG, lanczos", LANCZOS, cog(*COG_JPEG, "RESAMPLING=LANCZOS"), source),
            Program("gdaladdo", BOX, (*OVERVIEWS.split(), *factors), source, remark="coarse levels only, a quarter of all blocks"),
            Program("maketx", BOX, _maketx("--compression", "jpeg:85"), source, 2),
            Program("gdal2tiles.py, WebP", BOX, webp, source, 1, "quality 85, it knows no JPEG; adds an alpha channel"),
        ),
    )


def _small_jpeg(side: int) -> Case:
    source = Source("rgb", side)
    return Case(
        "jpeg-small",
        "RGB to JPEG, quality 85",
        (
            Program("clipmap", SINC_3, clipmap("imagery", "jpeg:85"), source),
            Program("vips dzsave", BOX, vips(".jpg[Q=85]"), source),
            Program("clipmap --filter box", BOX, clipmap("imagery", "jpeg:85", "--filter", "box"), source),
            Program("GDAL COG, average", BOX, cog(*COG_JPEG, "RESAMPLING=AVERAGE"), source),
            Program("GDAL COG, lanczos", LANCZOS, cog(*COG_JPEG, "RESAMPLING=LANCZOS"), source),
        ),
    )


def _png(side: int) -> Case:
    source = Source("rgb", side)
    return Case(
        "png",
        "RGB to PNG",
        (
            Program("clipmap", SINC_3, clipmap("imagery", "png"), source),
            Program("vips dzsave", BOX, vips(".png"), source),
            Program("gdal2tiles.py", BOX, tuple(GDAL2TILES.split()), source, 1, "adds an alpha channel"),
        ),
    )


def _heights(side: int) -> Case:
    source = Source("height", side)
    error = ("COMPRESS=LERC", "MAX_Z_ERROR=0.1")
    zstd, deflate = ("COMPRESS=ZSTD", "PREDICTOR=YES"), ("COMPRESS=DEFLATE", "PREDICTOR=YES")
    return Case(
        "heights",
        "float32 heights, error at most 0.1 m",
        (
            Program("clipmap lerc:0.1", SINC_6, clipmap("height", "lerc:0.1"), source),
            Program("GDAL COG LERC, lanczos", LANCZOS, cog(*error, "RESAMPLING=LANCZOS"), source),
            Program("GDAL COG LERC, average", BOX, cog(*error, "RESAMPLING=AVERAGE"), source),
            Program("clipmap lerc:0.1 --filter box", "box, 3 taps", clipmap("height", "lerc:0.1", "--filter", "box"), source),
            Program("clipmap exr:float", SINC_6, clipmap("height", "exr:float"), source, 2, "lossless"),
            Program("GDAL COG ZSTD, lanczos", LANCZOS, cog(*zstd, "RESAMPLING=LANCZOS"), source, 2, "lossless"),
            Program("GDAL COG DEFLATE, lanczos", LANCZOS, cog(*deflate, "RESAMPLING=LANCZOS"), source, 1, "lossless"),
            Program("clipmap png16", SINC_6, clipmap("height", "png16:0.1,-1000"), source, 1, "steps of 0.1 m"),
        ),
    )


def _workers(side: int) -> Case:
    source = Source("rgb", side)
    programs = [
        Program(
            f"clipmap {codec} --workers {count}",
            SINC_3,
            clipmap("imagery", codec, "--workers", str(count)),
            source,
            against=f"clipmap {codec} --workers 1",
        )
        for codec in ("png", "jpeg:85")
        for count in (1, 2)
    ]
    return Case("workers", "one worker and two", tuple(programs))


def _growth(small: int, large: int) -> Case:
    command = clipmap("imagery", "jpeg:85")
    programs = (Program(f"clipmap, {side} × {side}", SINC_3, command, Source("rgb", side)) for side in (small, large))
    return Case("growth", "RGB to JPEG, quality 85, small and very large", tuple(programs))


def _layouts(side: int) -> Case:
    programs = []
    for layout in LAYOUTS:
        source, own = Source("rgb", side, layout), f"clipmap: {layout}"
        programs += [
            Program(own, SINC_3, clipmap("imagery", "jpeg:85"), source, against=own),
            Program(f"vips dzsave: {layout}", BOX, vips(".jpg[Q=85]"), source, against=own),
            Program(f"GDAL COG, average: {layout}", BOX, cog(*COG_JPEG, "RESAMPLING=AVERAGE"), source, against=own),
        ]
    return Case("layouts", f"RGB to JPEG from other TIFF layouts than {PLAIN}", tuple(programs[3:]), runs=3)


def cases(side: int) -> list[Case]:
    """Return what is measured, in this order, the large sources having ``side`` samples a side."""
    half = side // 2
    return [_jpeg(side), _small_jpeg(half), _heights(side), _png(side), _workers(half), _layouts(half), _growth(half, 2 * side)]


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
        said = (answer.stdout or answer.stderr).strip().partition("\n")[0]
        found[name] = said.removeprefix(f"{name}, ")
    return found
