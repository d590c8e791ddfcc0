"""The base of what is set in a graph."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Group(BaseModel):
    """Settings that belong together: immutable, finite, and none but those that are declared."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
