"""What the command line shows while a run lasts."""

from __future__ import annotations

import logging
from itertools import pairwise

import numpy as np
import pytest

from mushpipe.console import Rate, set_up_logging


def rates(times: np.ndarray) -> list[float]:
    """Return the rate shown after each frame."""
    rate = Rate()
    return [rate.at(float(time), count) for count, time in enumerate(times, 1)]


def test_a_camera_that_slows_is_seen_within_seconds() -> None:
    fast = 100 + np.arange(3000) / 30  # however long it was fast, and however late it began
    slow = fast[-1] + np.arange(1, 61) / 15
    shown = rates(np.concatenate([fast, slow]))
    assert shown[0] == 0
    np.testing.assert_allclose(shown[1:3000], 30, rtol=0.01)
    np.testing.assert_allclose(shown[3000 + 31 :], 15, rtol=0.01)
    assert all(before >= after for before, after in pairwise(shown[2999:]))


def test_frames_that_are_further_apart_have_a_rate_as_well() -> None:
    assert rates(np.array([0, 10, 14])) == pytest.approx([0, 0.1, 0.25])


def test_a_notice_is_given_once_and_one_that_is_none_fails_no_frame(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logger = logging.getLogger("mushpipe")
    monkeypatch.setattr(logger, "level", logging.NOTSET)
    monkeypatch.setattr(logger, "propagate", False)  # pytest lets no such record pass
    set_up_logging(False)
    for _ in range(2):
        logger.info("frame %d", 3)
    logger.info("frame %d", "three")
    said = capsys.readouterr().err
    assert said.count("INFO: frame 3") == 1
    assert "TypeError: %d format" in said
