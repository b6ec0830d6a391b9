"""What commands that read a source have in common: channel lists, and settings checked in one place."""

from collections.abc import Mapping
from typing import Any

import click
from pydantic import ValidationError

from schemas.errors import UsageError
from schemas.settings import BuildSettings


def parse_bands(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, ...] | None:
    """Return the channel numbers of ``1,2,3``; a callback of click."""
    if value is None:
        return None
    try:
        return tuple(int(part) for part in value.split(","))
    except ValueError:
        raise click.BadParameter(f"{value!r}: channel numbers from 1, separated by commas, e.g. 1,2,3") from None


def build_settings(options: dict[str, Any]) -> BuildSettings:
    """Return the settings that options of the same names give; raises UsageError that names the option which is wrong."""
    try:
        return BuildSettings(**options)
    except ValidationError as error:
        raise refused(error, {}) from error


def refused(error: ValidationError, options: Mapping[str, str]) -> UsageError:
    """Return what settings are refused for first, and by which option; ``options`` name those that are not called as their settings."""
    first = error.errors(include_url=False)[0]
    name = str(first["loc"][0]) if first["loc"] else None
    option = "options" if name is None else "--" + options.get(name, name).replace("_", "-")
    return UsageError(f"{option}: {first['msg'].removeprefix('Value error, ')}")
