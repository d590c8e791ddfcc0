from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Circles, DepthSource, Locations, PickFlag, Poses
from mushpipe.stages.picks import MakePicks
from mushpipe.stages.tracks import Tracks
from tests.stages.scenes import frame_of

NAN = np.nan


def circles_at(*centers: tuple[float, float], radius: float = 8.0) -> Circles:
    n = len(centers)
    return Circles(np.reshape(centers, (n, 2)), np.full(n, radius), np.ones(n))


def locations(*sources: DepthSource) -> Locations:
    n = len(sources)
    present = np.array(sources) != DepthSource.MISSING
    position = np.where(present[:, None], [[0.01, 0.02, 0.5]], NAN)
    return Locations(
        position,
        np.linalg.norm(position, axis=1),
        np.where(present, 0.04, NAN),
        sources,
        np.full((n, 3), NAN),
        np.full(n, NAN),
    )


def test_flags_say_what_is_not_measured() -> None:
    circles = circles_at((50, 50), (80, 50), (110, 50), (4, 50))
    found = locations(
        DepthSource.MEASURED, DepthSource.NEIGHBOURS, DepthSource.MISSING, DepthSource.MEASURED
    )
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found)
    unknown = PickFlag.POSE_UNKNOWN
    assert [PickFlag(f) for f in picks.flags.tolist()] == [
        unknown,
        unknown | PickFlag.DEPTH_ESTIMATED,
        unknown | PickFlag.DEPTH_MISSING,
        unknown | PickFlag.AT_BORDER,
    ]
    assert np.isnan(picks.position[2]).all()
    assert np.isnan(picks.quaternion).all()
    assert picks.frame_id == "camera_color_optical_frame"


def test_the_apex_stands_in_for_the_surface_only_where_the_pose_is_valid() -> None:
    circles = circles_at((50, 50), (80, 50))
    poses = Poses(
        quaternion=[[1, 0, 0, 0], [NAN] * 4],
        axis=[[0, 0, -1], [NAN] * 3],
        apex=[[0.0, 0.0, 0.48], [NAN] * 3],
        sigma_rad=[0.1, NAN],
        fitness=[1.0, NAN],
        valid=[True, False],
    )
    found = locations(DepthSource.MEASURED, DepthSource.MEASURED)
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found, poses)
    assert picks.position.tolist() == [[0.0, 0.0, 0.48], [0.01, 0.02, 0.5]]
    assert [bool(f & PickFlag.POSE_UNKNOWN) for f in picks.flags] == [False, True]


def test_rows_must_agree() -> None:
    with pytest.raises(ValueError, match="2 circles, 1 locations, 2 poses"):
        MakePicks().process(
            frame_of(np.zeros((120, 160))),
            circles_at((50, 50), (80, 50)),
            locations(DepthSource.MEASURED),
        )


def test_the_end_of_a_run_says_how_many_picks_have_no_position(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stage = MakePicks()
    found = locations(DepthSource.MISSING, DepthSource.MEASURED)
    stage.process(frame_of(np.zeros((120, 160))), circles_at((50, 50), (80, 50)), found)
    with caplog.at_level(logging.WARNING, "mushpipe"):
        stage.close()
    assert "1 of 2 picks have no position: there is no depth at them" in caplog.messages


def test_an_empty_bed_gives_empty_picks() -> None:
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles_at(), locations())
    assert len(picks) == 0


@given(st.randoms(), st.integers(1, 12))
def test_ids_follow_their_mushroom_whatever_the_order(rng: object, n: int) -> None:
    centers = [(20.0 * i, 30.0) for i in range(n)]
    tracks = Tracks()
    first = tracks.update(circles_at(*centers), 0, 10)
    order = list(range(n))
    rng.shuffle(order)  # type: ignore[attr-defined]
    moved = [(centers[i][0] + 2.0, 31.0) for i in order]
    assert tracks.update(circles_at(*moved), 1, 10).tolist() == first[order].tolist()


def test_an_id_survives_a_gap_within_the_memory_and_is_never_used_again() -> None:
    tracks = Tracks()
    here, elsewhere = circles_at((50, 50)), circles_at((90, 90))
    assert tracks.update(here, 0, 10).tolist() == [0]
    assert tracks.update(elsewhere, 5, 10).tolist() == [1]
    assert tracks.update(here, 10, 10).tolist() == [0]
    assert tracks.update(circles_at(), 21, 10).tolist() == []
    assert tracks.update(here, 40, 10).tolist() == [2]


def test_a_jump_of_more_than_half_a_radius_is_another_mushroom() -> None:
    tracks = Tracks()
    tracks.update(circles_at((50, 50)), 0, 10)
    assert tracks.update(circles_at((54.1, 50)), 1, 10).tolist() == [1]


def test_picks_are_in_the_frame_of_their_image() -> None:
    frame = frame_of(np.zeros((120, 160)))
    other = replace(frame, header=replace(frame.header, frame_id="another_optical_frame"))
    picks = MakePicks().process(other, circles_at((50, 50)), locations(DepthSource.MEASURED))
    assert picks.frame_id == "another_optical_frame"
