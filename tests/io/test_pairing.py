"""Colour and depth that belong together; leftovers are counted, no colour image is ever lost."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from mushpipe.core.types import RgbdFrame
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.pairing import Pairing
from tests.io.bags import (
    PERIOD,
    T0,
    Entry,
    color_at,
    color_pixels,
    depth_at,
    depth_pixels,
    rgbd,
    write_bag,
)

MS = 1_000_000
ALONE = "colour images without depth"
LEFT = "depth images without colour"


def run(
    tmp_path: Path, entries: list[Entry], **settings: float
) -> tuple[list[RgbdFrame], dict[str, int]]:
    source = McapSource(path=write_bag(tmp_path, entries), **settings)
    return list(source.frames()), source.counts()


def partners(frames: list[RgbdFrame]) -> list[tuple[int, int | None]]:
    """Return which colour was paired with which depth, told by their pixels."""
    found = []
    for frame in frames:
        color = next(i for i in range(50) if np.array_equal(frame.color, color_pixels(i)))
        depths = (i for i in range(50) if np.array_equal(frame.depth, depth_pixels(i)))
        found.append((color, None if frame.depth is None else next(depths)))
    return found


@pytest.mark.parametrize("delay_ms", [-14, -1, 0, 1, 14])
def test_stamps_may_differ_a_little(delay_ms: int, tmp_path: Path) -> None:
    entries: list[Entry] = []
    for i in range(5):
        entries += [color_at(i), depth_at(i, T0 + i * PERIOD + delay_ms * MS)]
    frames, counts = run(tmp_path, entries)
    assert partners(frames) == [(i, i) for i in range(5)]
    assert counts == {}
    assert [f.header.stamp_ns for f in frames] == [T0 + i * PERIOD for i in range(5)]


def test_stamps_that_differ_too_much_are_not_paired_but_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    entries: list[Entry] = []
    for i in range(3):
        entries += [color_at(i), depth_at(i, T0 + i * PERIOD + 16 * MS)]
    frames, counts = run(tmp_path, entries, pair_tolerance_ms=15)
    assert partners(frames) == [(0, None), (1, None), (2, None)]
    assert counts == {ALONE: 3, LEFT: 3}
    assert "their stamps differ by more than source.pair_tolerance_ms, 15" in caplog.text


def test_a_few_images_without_a_partner_are_no_reason_for_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    entries = [color_at(0), depth_at(1), color_at(2), depth_at(2), color_at(3), depth_at(3)]
    assert run(tmp_path, entries)[1] == {ALONE: 1, LEFT: 1}
    assert "pair_tolerance_ms" not in caplog.text


def test_the_tolerance_is_a_setting(tmp_path: Path) -> None:
    entries = [color_at(0), depth_at(0, T0 + 1)]
    assert run(tmp_path / "a", entries, pair_tolerance_ms=0)[1] == {ALONE: 1, LEFT: 1}
    assert run(tmp_path / "b", entries, pair_tolerance_ms=0.001)[1] == {}


@pytest.mark.parametrize(
    ("depths", "expected", "counts"),
    [
        ([0, 1, 3, 4], [0, 1, None, 3, 4], {ALONE: 1}),
        ([0, 1], [0, 1, None, None, None], {ALONE: 3}),
        ([3, 4], [None, None, None, 3, 4], {ALONE: 3}),
        ([0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 3, 4], {LEFT: 2}),
        ([], [None] * 5, {}),
    ],
)
def test_missing_depth_never_costs_a_colour_image(
    depths: list[int], expected: list[int | None], counts: dict[str, int], tmp_path: Path
) -> None:
    entries = sorted([*map(color_at, range(5)), *map(depth_at, depths)], key=lambda e: e[1])
    frames, counted = run(tmp_path, entries)
    assert partners(frames) == list(enumerate(expected))
    assert counted == counts


def test_depth_that_ends_early_does_not_pile_up_colour(tmp_path: Path) -> None:
    source = McapSource(path=write_bag(tmp_path, [*rgbd([0]), *map(color_at, range(1, 45))]))
    frames = source.frames()
    assert partners([next(frames) for _ in range(45)])[-1] == (44, None)
    assert list(frames) == []
    assert source.counts() == {ALONE: 44}


def test_depth_may_be_recorded_before_its_colour(tmp_path: Path) -> None:
    entries = [e for i in range(4) for e in (depth_at(i), color_at(i))]
    frames, counts = run(tmp_path, entries)
    assert partners(frames) == [(i, i) for i in range(4)]
    assert counts == {}


def test_the_nearest_depth_is_taken(tmp_path: Path) -> None:
    entries = [
        depth_at(7, T0 - 9 * MS),
        depth_at(0, T0 - 2 * MS),
        color_at(0),
        depth_at(8, T0 + 5 * MS),
        color_at(1),
        depth_at(1),
    ]
    frames, counts = run(tmp_path, entries)
    assert partners(frames) == [(0, 0), (1, 1)]
    assert counts == {LEFT: 2}


def test_at_90_frames_per_second_a_lost_depth_does_not_shift_the_others(tmp_path: Path) -> None:
    # The period is shorter than the tolerance, so a neighbour's depth would do.
    period = 11 * MS
    entries: list[Entry] = []
    for i in range(6):
        entries.append(color_at(i, T0 + i * period))
        if i != 2:
            entries.append(depth_at(i, T0 + i * period))
    frames, counts = run(tmp_path, entries)
    assert partners(frames) == [(0, 0), (1, 1), (2, None), (3, 3), (4, 4), (5, 5)]
    assert counts == {ALONE: 1}


def test_a_clock_that_was_set_back_costs_nothing(tmp_path: Path) -> None:
    entries: list[Entry] = []
    for i in range(6):
        stamp = T0 + (i % 3) * PERIOD
        entries += [color_at(i, stamp), depth_at(i, stamp)]
    frames, counts = run(tmp_path, entries)
    assert partners(frames) == [(i, i) for i in range(6)]
    assert counts == {}


def in_chunks_of_one(path: Path) -> Path:
    """Write a bag anew with a chunk per message, as programs with small chunks do."""
    again = path.with_name("again.mcap")
    with path.open("rb") as file, again.open("wb") as out:
        writer, channels = Writer(out, chunk_size=1), dict[int, int]()
        writer.start()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", kind)
            times = message.log_time, message.publish_time
            writer.add_message(channels[channel.id], times[0], message.data, times[1])
        writer.finish()
    return again


def test_where_halves_of_a_file_changed_places_it_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing is lost, but tracks and pace go by an order that is not that of time."""
    turned = [3, 4, 5, 0, 2, 1]
    entries = [each for i in turned for each in (color_at(i), depth_at(i))]
    path = in_chunks_of_one(write_bag(tmp_path, entries))
    source = McapSource(path=path, loop=2)
    frames = list(source.frames())
    assert partners(frames) == [(i, i) for i in turned] * 2
    assert source.counts() == {}
    said = [r.getMessage() for r in caplog.records if "stamps go back" in r.getMessage()]
    assert len(said) == 1
    assert f"stamps go back by {5 * PERIOD / 1e9:.3f} s at frame 3; frames are played in" in said[0]


@pytest.mark.parametrize(
    ("arriving", "pairs", "alone"),
    [
        ("c1000 d1004 c1004", [(1000, None), (1004, 1004)], (1, 0)),
        ("c1000 c1004 d1001", [(1000, 1001), (1004, None)], (1, 0)),
        ("d1002 c1000 c1004", [(1000, 1002), (1004, None)], (1, 0)),  # as near to either
        # Clocks that were set back:
        ("d1000 d510 c543 d543", [(543, 543)], (0, 2)),
        ("c1000 d1002 d962", [(1000, 1002)], (0, 1)),
    ],
)
def test_depth_belongs_to_the_nearest_colour(
    arriving: str, pairs: list[tuple[int, int | None]], alone: tuple[int, int]
) -> None:
    pairing: Pairing[int, int] = Pairing(5)
    found = []
    for item in arriving.split():
        stamp = int(item[1:])
        found += (pairing.add_color if item[0] == "c" else pairing.add_depth)(stamp, stamp)
    found += pairing.finish()
    assert found == pairs
    assert (pairing.color_alone, pairing.depth_alone) == alone


@pytest.mark.parametrize("arriving", ["c1000 d1000", "c1000 d1001 c1033", "d998 c1000 d1031"])
def test_a_pair_waits_for_no_more_than_what_could_change_it(arriving: str) -> None:
    pairing: Pairing[int, int] = Pairing(5)
    waiting = True
    for item in arriving.split():
        assert waiting
        stamp = int(item[1:])
        add = pairing.add_color if item[0] == "c" else pairing.add_depth
        waiting = not list(add(stamp, stamp))
    assert not waiting


def test_depth_without_colour_for_long_is_not_kept() -> None:
    pairing: Pairing[str, int] = Pairing(0)
    for stamp in range(1000):
        assert list(pairing.add_depth(stamp, stamp)) == []
    assert pairing.depth_alone == 1000 - Pairing.PATIENCE
    assert list(pairing.add_color(999, "last")) == [("last", 999)]
    assert list(pairing.finish()) == []
    assert pairing.depth_alone == 999


def brute_force(colors: list[int], depths: list[int], tolerance: int) -> set[int]:
    """Return the colours that have any depth within the tolerance."""
    return {c for c in colors if any(abs(c - d) <= tolerance for d in depths)}


stamps = st.sets(st.integers(0, 300), max_size=25).map(sorted)


@given(colors=stamps, depths=stamps, tolerance=st.integers(0, 20))
def test_every_colour_comes_out_once_in_order_and_every_depth_is_accounted_for(
    colors: list[int], depths: list[int], tolerance: int
) -> None:
    pairing: Pairing[int, int] = Pairing(tolerance)
    arriving = sorted([(s, "color") for s in colors] + [(s, "depth") for s in depths])
    out: list[tuple[int, int | None]] = []
    for stamp, kind in arriving:
        out += (pairing.add_color if kind == "color" else pairing.add_depth)(stamp, stamp)
    out += pairing.finish()
    assert [color for color, _ in out] == colors
    paired = [(color, depth) for color, depth in out if depth is not None]
    assert all(abs(color - depth) <= tolerance for color, depth in paired)
    assert [depth for _, depth in paired] == sorted({depth for _, depth in paired})
    assert pairing.color_alone == len(colors) - len(paired)
    assert pairing.depth_alone == len(depths) - len(paired)
    assert {color for color, _ in paired} <= brute_force(colors, depths, tolerance)
    assert {color for color, depth in paired if color == depth} == {*colors} & {*depths}
    if all(b - a > 2 * tolerance for a, b in pairwise(colors)):
        # No two colours compete for a depth, so each that can have one gets one.
        assert {color for color, _ in paired} == brute_force(colors, depths, tolerance)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 60)), max_size=60), st.integers(0, 5))
def test_no_pair_is_further_apart_than_the_tolerance(
    items: list[tuple[bool, int]], tolerance: int
) -> None:
    """Whatever order stamps come in."""
    pairing: Pairing[int, int] = Pairing(tolerance)
    pairs = []
    for is_color, stamp in items:
        pairs += (pairing.add_color if is_color else pairing.add_depth)(stamp, stamp)
    pairs += pairing.finish()
    assert all(depth is None or abs(color - depth) <= tolerance for color, depth in pairs)
    assert [color for color, _ in pairs] == [stamp for is_color, stamp in items if is_color]


few = st.sets(st.integers(0, 59), max_size=6)


@given(lost_colors=few, lost_depths=few, tolerance=st.integers(0, 100), late=st.integers(0, 9))
def test_of_numbered_items_none_lost_costs_another_its_partner(
    lost_colors: set[int], lost_depths: set[int], tolerance: int, late: int
) -> None:
    """However close frames follow one another."""
    pairing: Pairing[int, int] = Pairing(max(tolerance, late))
    pairs = []
    for number in range(60):
        if number not in lost_colors:
            pairs += pairing.add_color(11 * number, number, number)
        if number not in lost_depths:
            pairs += pairing.add_depth(11 * number + late, number, number)
    pairs += pairing.finish()
    kept = [number for number in range(60) if number not in lost_colors]
    assert pairs == [(k, None if k in lost_depths else k) for k in kept]


@pytest.mark.parametrize("lost", [None, "color", "depth"])
@pytest.mark.parametrize("first", ["color", "depth"])
def test_after_stamps_went_back_pairs_are_found_at_once(first: str, lost: str | None) -> None:
    pairing: Pairing[int, int] = Pairing(5)
    pairs = []
    for number in range(80):
        stamp = 10_000 + 33 * number - (3000 if number >= 40 else 0)
        for kind in ("color", "depth") if first == "color" else ("depth", "color"):
            if not (number == 39 and kind == lost):
                add = pairing.add_color if kind == "color" else pairing.add_depth
                pairs += add(stamp, stamp)
    pairs += pairing.finish()
    assert sum(depth == color for color, depth in pairs) >= 77
    assert all(depth in (None, color) for color, depth in pairs)
