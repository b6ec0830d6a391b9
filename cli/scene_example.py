"""A scene file to start from, written from the scene's own fields, so that it never says what is not so."""

import textwrap
from typing import Final

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from schemas.scene import Scene

_SUN: Final = {"azimuth_deg": "270.0", "elevation_deg": "10.0"}
"""Fields that have no default and must be given."""
_TIME: Final = "2026-06-21T05:00:00Z"


def example_scene() -> str:
    """Return the text of a TOML file: every field with what it means, those that have a default commented out with it."""
    parts = ["# A scene: what it is lit by, who looks at it, and what nobody notices.\n# Remove the # before a setting to change it.\n"]
    for name, field in Scene.model_fields.items():
        section = field.annotation
        if not (isinstance(section, type) and issubclass(section, BaseModel)):
            raise TypeError(name)
        settings = [_setting(key, one) for key, one in section.model_fields.items()]
        parts.append("\n".join([f"[{name}]", *settings]) + "\n")
    return "\n".join(parts)


def _setting(key: str, field: FieldInfo) -> str:
    meaning = textwrap.fill(field.description or "", 100, initial_indent="# ", subsequent_indent="# ")
    if key in _SUN:
        return f"{meaning}\n{key} = {_SUN[key]}"
    return f"{meaning}\n# {key} = {_TIME if key == 'when' else _toml(field.default)}"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
