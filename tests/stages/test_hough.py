from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from mushpipe import Mask
from mushpipe.stages.hough import Hough, HoughSkimage, disc_cover, first_of_each_place
from tests.stages.scenes import discs, frame_of

TRUTH = [(40.0, 40.0, 15.0), (100.0, 70.0, 20.0), (130.0, 25.0, 12.0)]


@pytest.mark.parametrize("source", ["image", "mask"])
@pytest.mark.parametrize("method", ["alt", "gradient", "skimage"])
def test_separate_discs_are_found_once_each(source: str, method: str) -> None:
    image = discs(TRUTH, 0.8, 0.2)
    peer = HoughSkimage(input=source)
    stage = peer if method == "skimage" else Hough(input=source, method=method, votes=10)
    circles = stage.process(frame_of(image), Mask(image > 0.5))
    found = np.column_stack([circles.center, circles.radius])
    assert len(found) == len(TRUTH)
    for x, y, r in TRUTH:
        nearest = found[np.argmin(np.hypot(found[:, 0] - x, found[:, 1] - y))]
        assert nearest == pytest.approx((x, y, r), abs=1.6)
    assert (circles.score > 0.9).all()


@pytest.mark.parametrize("stage", [Hough(), HoughSkimage(), HoughSkimage(radius_px=(200, 300))])
def test_nothing_to_see_gives_no_circles(stage: Hough | HoughSkimage) -> None:
    image = np.full((120, 160), 0.3)
    assert len(stage.process(frame_of(image), Mask(image > 0.5))) == 0


def test_a_circle_outside_the_mask_is_not_kept() -> None:
    image = discs(TRUTH, 0.8, 0.2)
    mask = discs(TRUTH[:1], 1, 0) > 0.5
    circles = Hough().process(frame_of(image), Mask(mask))
    assert circles.center == pytest.approx(np.array([TRUTH[0][:2]]), abs=1.6)


def test_disc_cover_is_a_share_of_the_part_inside_the_image() -> None:
    left_half = np.zeros((60, 60), bool)
    left_half[:, :30] = True
    assert disc_cover(left_half, 29.5, 30, 10) == pytest.approx(0.5, abs=0.02)
    assert disc_cover(left_half, 0, 30, 10) == 1.0
    assert disc_cover(left_half, 500, 500, 10) == 0.0


def test_the_first_circle_of_a_place_stays() -> None:
    circles = np.array([[50, 50, 10], [52, 50, 12], [62, 50, 10], [50, 65, 30]], float)
    assert first_of_each_place(circles, 0.7).tolist() == [0, 2]


def test_a_radius_range_the_wrong_way_round_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"radius_px must be \[smallest, largest\]"):
        Hough(radius_px=(38, 8))
