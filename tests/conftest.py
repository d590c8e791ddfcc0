"""Fixtures shared by the tests."""

import logging
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.core.lab import Lab

# No example fails for being slow: a busy machine is no fault of the code.
settings.register_profile("mushpipe", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mushpipe")


@pytest.fixture(autouse=True)
def own_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """What sets up the program's log does so for one test: its stream ends with that."""
    monkeypatch.setattr(logging.getLogger("mushpipe"), "handlers", [])


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    """A fresh registry of small plugins, and graphs run on it."""
    return Lab(tmp_path)
