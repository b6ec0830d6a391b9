"""From source files to the samples of a layer: which file becomes what, and what changes its samples before the pyramid is built."""

from collections.abc import Callable, Sequence
from pathlib import Path

from schemas.errors import UsageError
from schemas.settings import BuildSettings
from tiler.samples.stretch import Ranges, StretchedSource, find_ranges, parse_stretch
from tiler.samples.transfer import LinearLight
from tiler.sources import Reader
from tiler.sources.convert import SampleSource, Source, choose_conversion
from tiler.sources.disguise import refuse_disguised_heights
from tiler.sources.files import open_file

KnownRanges = Callable[[SampleSource], Ranges | None]
"""Tells what an earlier pass over the same source found for the same stretch; None if there was none."""


def open_samples(
    sources: Sequence[Path], scratch: Path, settings: BuildSettings, workers: int, known_ranges: KnownRanges = lambda source: None
) -> SampleSource:
    """Open the source files as the samples of one layer.

    A stretch by a cut reads the whole source once, unless its ranges are known. Raises UsageError or InputError.
    """
    reader = _open(sources, scratch, settings)
    try:
        source: SampleSource = Source(reader, choose_conversion(reader.info, settings))
        if settings.decode is None:
            refuse_disguised_heights(reader, source.conversion)
        return _prepared(source, settings, workers, known_ranges)
    except BaseException:
        reader.close()
        raise


def _open(sources: Sequence[Path], scratch: Path | None, settings: BuildSettings) -> Reader:
    if settings.mosaic:
        from tiler.sources.mosaic import open_mosaic  # noqa: PLC0415 - 12 ms of every start, for rasterio's warping

        return open_mosaic(
            sources,
            scratch,
            settings.max_samples,
            settings.nodata,
            kernel="bilinear" if settings.layer == "height" else None,
            encoded=settings.decode not in (None, "none"),
        )
    return open_file(_only(sources), scratch, settings.max_samples)


def _only(sources: Sequence[Path]) -> Path:
    if len(sources) != 1:
        raise UsageError(
            f"{len(sources)} sources: add --mosaic to put them on one lattice, or build one dataset of each with clipmap batch"
        )
    return sources[0]


def _prepared(source: SampleSource, settings: BuildSettings, workers: int, known_ranges: KnownRanges) -> SampleSource:
    if settings.stretch is not None:
        stretch = parse_stretch(settings.stretch)
        source = StretchedSource(source, known_ranges(source) or find_ranges(source, stretch, workers))
    if settings.fill:
        if source.conversion.kind != "height":
            raise UsageError("--fill is for heights; voids of imagery stay transparent")
        from tiler.samples.fill import FilledSource  # noqa: PLC0415 - as below

        source = FilledSource(source, settings.fill)
    if settings.enhance is not None:
        from tiler.samples.enhance import EnhancedSource, parse_enhancement  # noqa: PLC0415 - 4 ms of every start, used by few

        source = EnhancedSource(source, parse_enhancement(settings.enhance))
    if settings.linear_light:
        if source.conversion.kind != "imagery":
            raise UsageError("--linear-light is for imagery; heights are linear already")
        source = LinearLight(source)
    return source


def open_headers(sources: Sequence[Path], settings: BuildSettings) -> SampleSource:
    """Open the source files as ``open_samples`` does, for what their headers say: no pixel is read, nothing is decoded or found out.

    A range to stretch by, if it is to be found, is any; pixels of files that cannot be read by window must not be asked for.
    Raises UsageError or InputError.
    """
    reader = _open(sources, None, settings)
    try:
        return _prepared(
            Source(reader, choose_conversion(reader.info, settings)), settings, 1, lambda source: ((0.0, 1.0),) * source.conversion.channels
        )
    except BaseException:
        reader.close()
        raise
