"""The base of everything that is stored or printed as JSON."""

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """Base of the manifest's parts: immutable, no unknown fields, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, json_schema_serialization_defaults_required=True)
