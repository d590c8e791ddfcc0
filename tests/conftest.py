"""Fixtures shared by the tests."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.core.lab import Lab

# No example fails for being slow: a busy machine is no fault of the code.
settings.register_profile("mushpipe", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mushpipe")


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    """A fresh registry of small plugins, and graphs run on it."""
    return Lab(tmp_path)
