from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Circles, DepthSource, Locations
from mushpipe.stages.tracks import PAUSE_NS, Tracks
from tests.stages.scenes import CAMERA

IMAGE = (CAMERA.width, CAMERA.height)


def seen(
    *rows: tuple[float, float, float], radius: float | tuple[float, ...] = 8.0
) -> tuple[Circles, Locations]:
    """Mushrooms at u, v (px) and z (m); a z of NaN is missing."""
    u, v, z = np.reshape(rows, (len(rows), 3)).T
    center, n = np.stack([u, v], axis=1), len(u)
    radius = np.broadcast_to(radius, n)
    position = CAMERA.deproject(center, z)
    missing = np.isnan(z)
    position[missing] = np.nan
    return Circles(center, radius, np.ones(n)), Locations.unknown(
        n,
        position=position,
        distance=np.linalg.norm(position, axis=1),
        diameter=2 * radius * z / CAMERA.fx,
        source=np.where(missing, DepthSource.MISSING, DepthSource.MEASURED),
    )


def ids(tracks: Tracks, *rows: tuple[float, float, float], at: int = 0) -> list[int]:
    return tracks.update(*seen(*rows), IMAGE, at, 10).tolist()


flat = st.lists(
    st.tuples(st.integers(0, 7), st.integers(0, 5)), min_size=6, max_size=20, unique=True
)


@given(
    st.randoms(),
    flat,
    st.tuples(st.floats(-25, 25), st.floats(-25, 25)),
    st.sampled_from([0.5, np.nan]),
)
def test_ids_follow_a_bed_that_shifts_whatever_the_order(
    rng: object, cells: list[tuple[int, int]], shift: tuple[float, float], z: float
) -> None:
    """Mushrooms 20 px apart on average; the whole bed shifts by up to more than that."""
    jitter = np.random.default_rng(len(cells)).uniform(-6, 6, (len(cells), 2))
    places = [(20.0 * x + j, 20.0 * y + k, z) for (x, y), (j, k) in zip(cells, jitter, strict=True)]
    tracks = Tracks()
    first = ids(tracks, *places)
    order = list(range(len(places)))
    rng.shuffle(order)  # type: ignore[attr-defined]
    moved = [(places[i][0] + shift[0], places[i][1] + shift[1], z) for i in order]
    assert ids(tracks, *moved, at=1) == [first[i] for i in order]


def test_ids_follow_a_moving_camera_though_some_leave_and_some_come() -> None:
    rng = np.random.default_rng(0)
    bed = np.column_stack([rng.uniform(0, 400, 90), rng.uniform(10, 110, 90)])
    bed = bed[[all(np.hypot(*(p - q)) > 14 for q in bed[:i]) for i, p in enumerate(bed)]]
    z = rng.uniform(0.46, 0.5, len(bed))
    tracks, names = Tracks(), {}
    for step in range(10):
        u = bed[:, 0] - 21.0 * step * 0.48 / z
        view = np.flatnonzero((u > 0) & (u < IMAGE[0]) & (rng.random(len(bed)) > 0.1))
        rows = np.column_stack([u, bed[:, 1], z])[view] + rng.normal(0, [0.5, 0.5, 0.001])
        for mushroom, name in zip(view, ids(tracks, *map(tuple, rows), at=step), strict=True):
            assert names.setdefault(mushroom, name) == name
    assert len(names) == len(set(names.values())) > 30


def test_a_nearer_mushroom_is_not_the_one_behind_it() -> None:
    tracks = Tracks()
    assert ids(tracks, (50, 50, 0.50)) == [0]
    assert ids(tracks, (50, 50, 0.46), at=1) == [1]
    assert ids(tracks, (50, 50, np.nan), at=2) in ([0], [1])


def test_one_without_depth_does_not_give_its_id_to_one_of_another_size() -> None:
    tracks = Tracks()
    both = seen((50, 50, np.nan), (56, 50, 0.5), radius=(12.0, 8.0))
    assert tracks.update(*both, IMAGE, 0, 10).tolist() == [0, 1]
    left = seen((52.8, 50, 0.5), radius=(8.5,))
    assert tracks.update(*left, IMAGE, 1, 10).tolist() == [1]


@pytest.mark.parametrize("z", [0.5, np.nan])
def test_a_little_difference_in_size_counts_no_more_than_the_place(z: float) -> None:
    """In gates of 4 px: 0.88 and none, beside 0.62 and 0.2."""
    tracks = Tracks()
    both = seen((50, 50, z), (56, 50, z), radius=(8.0, 8.8))
    assert tracks.update(*both, IMAGE, 0, 10).tolist() == [0, 1]
    assert tracks.update(*seen((53.5, 50, z)), IMAGE, 1, 10).tolist() == [1]


def test_an_id_survives_a_gap_within_the_memory_and_is_never_used_again() -> None:
    here, elsewhere = (50, 50, 0.5), (90, 90, 0.5)
    tracks = Tracks()
    assert ids(tracks, here) == [0]
    assert ids(tracks, elsewhere, at=5) == [1]
    assert ids(tracks, here, at=10) == [0]
    assert ids(tracks, at=21) == []
    assert ids(tracks, here, at=40) == [2]


def test_what_is_found_after_a_pause_is_another_mushroom() -> None:
    here = (50, 50, 0.5)
    tracks = Tracks()
    assert ids(tracks, here) == [0]
    assert ids(tracks, here, at=PAUSE_NS) == [0]  # the next picture of a slow camera
    assert ids(tracks, here, at=2 * PAUSE_NS + 1) == [1]
    assert tracks.update(*seen(here), IMAGE, 9 * PAUSE_NS, 8 * PAUSE_NS).tolist() == [1]


def test_an_id_does_not_outlive_stamps_that_go_back() -> None:
    here, elsewhere = (50, 50, 0.5), (90, 90, 0.5)
    tracks = Tracks()
    assert ids(tracks, here, at=1000) == [0]
    assert ids(tracks, elsewhere, at=10) == [1]
    assert ids(tracks, here, at=12) == [2]


def test_ids_follow_a_moving_camera_when_the_clock_is_set_back_within_the_memory() -> None:
    """Two that went out of view before have later stamps than all the others."""
    grid = [(24.0 * x + 14, 24.0 * y + 14, 0.5) for x in range(6) for y in range(4)]
    tracks, now, memory = Tracks(), 100_000, 10_000
    found = []
    for step in range(6):
        now += 33 if step != 2 else -2000
        rows = [(u + 3.7 * step, v, z) for u, v, z in grid[2 * (step > 1) :]]
        found.append(tracks.update(*seen(*rows), IMAGE, now, memory).tolist()[-22:])
    assert found == [found[0]] * 6


def test_a_jump_of_more_than_half_a_radius_is_another_mushroom() -> None:
    tracks = Tracks()
    ids(tracks, (50, 50, 0.5))
    assert ids(tracks, (54.1, 50, 0.5), at=1) == [1]


def test_one_that_moves_alone_does_not_move_the_others() -> None:
    tracks = Tracks()
    places = [(20.0, 30.0, 0.5), (60.0, 30.0, 0.5), (100.0, 30.0, 0.5), (140.0, 30.0, 0.5)]
    ids(tracks, *places)
    assert ids(tracks, (30.0, 30.0, 0.5), *places[1:], at=1) == [4, 1, 2, 3]


def test_a_step_that_only_the_large_ones_stay_in_their_gate_at_takes_no_id_away() -> None:
    """22 of 24 are within half a radius of where they were, the small ones are not."""
    grid = [(40.0 * x + 20, 40.0 * y + 20, 0.5) for x in range(6) for y in range(4)]
    radius = np.where(np.arange(len(grid)) % 12 == 5, 6.0, 18.0)
    for depth in (0.5, np.nan):
        tracks, found = Tracks(), []
        for step in range(4):
            rows = [(u + 5 * step, v + 2 * step, depth) for u, v, _ in grid]
            circles, locations = seen(*rows)
            sized = replace(circles, radius=radius)
            found.append(
                tracks.update(
                    sized,
                    replace(locations, diameter=2 * radius * 0.5 / CAMERA.fx),
                    IMAGE,
                    step,
                    10,
                ).tolist()
            )
        assert found == [found[0]] * 4


def test_after_a_turn_to_another_bed_ids_follow_its_shifts_at_once() -> None:
    """What was seen before the turn is remembered in the same places of the image."""
    rng = np.random.default_rng(1)
    grid = np.array([(x, y) for x in range(20, 300, 24) for y in range(20, 220, 24)], float)
    first, second = grid[:60], rng.permutation(grid + 12)[:25]
    tracks = Tracks()
    tracks.update(*seen(*((u, v, 0.5) for u, v in first)), (320, 240), 0, 10**9)
    names = []
    for step in range(4):
        rows = [(u + 10.0 * step, v, 0.5) for u, v in second]
        names.append(tracks.update(*seen(*rows), (320, 240), 1 + step, 10**9).tolist())
    assert names[1:] == names[:1] * 3


def test_a_row_that_loses_one_end_and_gains_the_other_has_not_shifted_by_a_pitch() -> None:
    """The first is picked; a fourth comes to light at once, or while that one is remembered."""
    row = [(40 + 17.0 * i, 60.0, 0.5) for i in range(4)]
    tracks = Tracks()
    assert ids(tracks, *row[:3]) == [0, 1, 2]
    assert ids(tracks, *row[1:], at=1) == [1, 2, 3]
    tracks = Tracks()
    ids(tracks, *row[:3])
    assert ids(tracks, *row[1:3], at=1) == [1, 2]
    assert ids(tracks, *row[1:], at=2) == [1, 2, 3]


def dense(seed: int) -> np.ndarray:
    """Return centres (N, 2) in an image of 640x480 of caps with a radius of 24 that do not overlap.

    The outer ones stay in the image however the camera turns.
    """
    points = np.random.default_rng(seed).uniform(-230, 230, (600, 2))
    kept: list[np.ndarray] = []
    for point in points[np.hypot(*points.T) < 230]:
        if all(np.hypot(*(point - other)) > 46 for other in kept):
            kept.append(point)
    return np.array(kept)


@pytest.mark.parametrize("z", [0.5, np.nan])
@pytest.mark.parametrize("degrees", [10, 45, 180])
def test_after_a_turn_no_mushroom_gets_the_id_of_another(degrees: float, z: float) -> None:
    """A cap that happens to come where another one was must not be done because that one is."""
    turn = np.exp(1j * np.radians(degrees))
    for seed in range(4):
        bed = dense(seed)
        turned = bed @ np.array([[turn.real, turn.imag], [-turn.imag, turn.real]])
        tracks, found = Tracks(), []
        for step, places in enumerate((bed, turned, turned)):
            rows = [(u + 320, v + 240, z) for u, v in places]
            now = tracks.update(*seen(*rows, radius=24), (640, 480), step, 10**9)
            found.append(now.tolist())
        assert len(bed) > 25
        assert not set(found[0]) & set(found[1])
        assert found[2] == found[1]


def bed(rng: np.random.Generator, number: int, radius: float) -> list[tuple[float, float, float]]:
    """Return up to that many mushrooms anywhere in view, none above another."""
    places: list[np.ndarray] = []
    for place in rng.uniform((radius, radius), (640 - radius, 480 - radius), (2000, 2)):
        if len(places) == number:
            break
        if (np.linalg.norm(place - np.reshape(places, (-1, 2)), axis=1) > 1.9 * radius).all():
            places.append(place)
    return [(u, v, rng.uniform(0.44, 0.46)) for u, v in places]


@pytest.mark.parametrize("radius", [24.0, 40.0])
@pytest.mark.parametrize("number", [4, 8, 15, 25])
def test_after_a_jump_to_another_bed_hardly_ever_an_id_is_kept(radius: float, number: int) -> None:
    kept = 0
    for seed in range(100):
        rng, tracks = np.random.default_rng([seed, number]), Tracks()
        views = [seen(*bed(rng, number, radius), radius=radius) for _ in range(2)]
        first, second = (
            set(tracks.update(*view, (640, 480), at, 10**9).tolist())
            for at, view in enumerate(views)
        )
        kept += bool(first & second)
    assert kept <= 5


@pytest.mark.parametrize("memory_s", [1, 60])
def test_beds_seen_one_after_the_other_keep_none_of_their_ids_however_long_the_memory(
    memory_s: int,
) -> None:
    kept = total = 0
    for seed in range(5):
        rng, tracks, known = np.random.default_rng(seed), Tracks(), set[int]()
        for stretch in range(12):
            view = seen(*bed(rng, 20, 40.0), radius=40.0)
            now = tracks.update(*view, (640, 480), stretch * 10**9, memory_s * 10**9).tolist()
            kept, total = kept + len(known & set(now)), total + len(now)
            known |= set(now)
    assert kept <= 0.01 * total


def test_the_few_that_an_arm_leaves_in_view_keep_their_ids_whatever_is_found_on_it() -> None:
    bed = dense(1) + np.array([320, 240])
    left = bed[bed[:, 0] < np.sort(bed[:, 0])[4]]
    on_arm = [(400.0 + 60 * i, 90.0 + 70 * i, 0.3) for i in range(6)]
    tracks = Tracks()
    first = tracks.update(*seen(*((u, v, 0.5) for u, v in bed), radius=24), (640, 480), 0, 10**9)
    rows = [*((u, v, 0.5) for u, v in left), *on_arm]
    now = tracks.update(*seen(*rows, radius=24), (640, 480), 1, 10**9).tolist()
    assert now[:4] == [first[i] for i in range(len(bed)) if bed[i, 0] in left[:, 0]]
    assert not set(now[4:]) & set(first.tolist())
