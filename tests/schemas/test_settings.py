"""Settings are frozen, complete and refuse nonsense; errors end in the documented exit codes."""

import math
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

import schemas.errors
from cli.exit_codes import exit_code
from schemas.errors import ClipmapError, InputError, MissingExtraError, NotFoundError, StorageError, UsageError
from schemas.settings import BuildSettings, ServerSettings

SERVER: dict[str, Any] = {"roots": (Path("data"),)}


def test_defaults() -> None:
    settings = BuildSettings()
    assert (settings.block, settings.filter, settings.radius, settings.overwrite) == (256, "blackman-sinc", None, False)
    server = ServerSettings(**SERVER)
    assert (server.host, server.port) == ("127.0.0.1", 8000), "nothing is served beyond this machine unless asked to"


@pytest.mark.parametrize("model", [BuildSettings, ServerSettings])
def test_every_field_says_what_it_means(model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        assert field.description, f"{model.__name__}.{name} has no description"


@pytest.mark.parametrize("settings", [BuildSettings(), ServerSettings(**SERVER)])
def test_settings_are_frozen(settings: BaseModel) -> None:
    for name in type(settings).model_fields:
        with pytest.raises(ValidationError, match="frozen"):
            setattr(settings, name, getattr(settings, name))


@pytest.mark.parametrize(
    "changes",
    [
        {"layer": "colour"},
        {"filter": "sinc"},
        {"radius": 0},
        {"radius": 17},
        {"workers": 0},
        {"workers": 257},
        {"workers": 1.5},
        {"task": 1},
        {"decode": "rgb"},
        {"height_scale": 0.0},
        {"height_scale": math.inf},
        {"height_offset": math.nan},
        {"spacing": 0.0},
        {"bands": ()},
        {"bands": (0,)},
        {"bands": (1, 2, 3, 4, 5)},
        {"spacing": -1.0},
        {"spacing": math.inf},
        {"block": "large"},
        {"blok": 256},
    ],
    ids=str,
)
def test_nonsense_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        BuildSettings(**changes)


@pytest.mark.parametrize("changes", [{"roots": ()}, {"port": -1}, {"port": 65536}, {"prot": 80}], ids=str)
def test_a_server_refuses_nonsense(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        ServerSettings(**SERVER | changes)


@pytest.mark.parametrize(
    ("error", "code"),
    [(UsageError, 2), (MissingExtraError, 2), (InputError, 3), (NotFoundError, 3), (StorageError, 4), (ClipmapError, 3)],
)
def test_every_error_has_its_exit_code(error: type[ClipmapError], code: int) -> None:
    assert exit_code(error("a sentence")) == code


def test_no_error_is_without_an_exit_code() -> None:
    """A class added to schemas/errors.py needs a row in the table above."""
    defined = {value for value in vars(schemas.errors).values() if isinstance(value, type)}
    assert defined == {ClipmapError, UsageError, InputError, NotFoundError, StorageError, MissingExtraError}
    assert all(issubclass(error, ClipmapError) for error in defined)
