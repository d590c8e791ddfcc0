"""What `mushpipe info` tells of a recording, and `mushpipe plugins` of plugins."""

from __future__ import annotations

import json
import re
from enum import Enum
from pathlib import Path
from typing import Literal

import pytest
from mcap.writer import Writer
from pydantic import Field

from mushpipe import Circles, Mask, Registry, RgbdFrame, Sink, Stage
from mushpipe.core.errors import InputError, PluginError
from mushpipe.core.group import Group
from mushpipe.core.plugins import Broken
from mushpipe.info import describe, describe_plugin, plugin_rows, render, render_plugins
from tests.io.bags import ALIGNED, COLOR, COLOR_INFO, PERIOD, T0, rgbd, write_bag, write_foxglove
from tests.io.values import MANIFEST, make_circles, make_frame, record, trace_of


def counts(content: dict) -> dict[str, tuple[str, int]]:
    return {t["topic"]: (t["schema"], t["messages"]) for t in content["topics"]}


def test_a_bag_is_described(tmp_path: Path) -> None:
    path = write_bag(tmp_path, rgbd(range(4)))
    content = describe(path)
    assert counts(content) == {
        COLOR: ("sensor_msgs/msg/Image", 4),
        ALIGNED: ("sensor_msgs/msg/Image", 4),
        COLOR_INFO: ("sensor_msgs/msg/CameraInfo", 1),
    }
    assert content["file"] == str(path)
    assert content["bytes"] == path.stat().st_size
    assert content["start_ns"] == T0
    assert content["duration_s"] == pytest.approx(3 * PERIOD / 1e9, abs=1e-6)
    assert (content["damage"], content["results_of"], content["attachments"]) == ([], "", [])
    assert json.loads(json.dumps(content)) == content


def test_the_text_has_a_line_per_topic(tmp_path: Path) -> None:
    path = write_bag(tmp_path, rgbd(range(4)))
    lines = render(describe(path)).splitlines()
    assert lines[0] == f"{path}: {path.stat().st_size / 1e6:.2f} MB, 0.099 s"
    assert [line.split() for line in lines[1:-1]] == [
        [ALIGNED, "sensor_msgs/msg/Image", "4"],
        [COLOR_INFO, "sensor_msgs/msg/CameraInfo", "1"],
        [COLOR, "sensor_msgs/msg/Image", "4"],
    ]


def test_a_bag_without_checksums_says_so(tmp_path: Path) -> None:
    note = "without checksums: bytes that changed since it was recorded show nowhere"
    assert render(describe(write_bag(tmp_path, rgbd(range(1))))).splitlines()[-1] == note
    checked = record(tmp_path / "out.mcap", [trace_of(make_frame(), detect=make_circles())])
    assert note not in render(describe(checked))


@pytest.mark.parametrize("checked", [True, False])
def test_without_chunks_only_the_checksum_of_all_data_tells(checked: bool, tmp_path: Path) -> None:
    path = tmp_path / "flat.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, enable_data_crcs=checked)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        topic = writer.register_channel("/a", "cdr", schema)
        writer.add_message(topic, T0, b"0000", T0)
        writer.finish()
    content = describe(path)
    assert (content["damage"], content["unchecked"]) == ([], not checked)


def test_results_carry_the_manifest_of_their_run(tmp_path: Path) -> None:
    path = record(tmp_path / "out.mcap", [trace_of(make_frame(), detect=make_circles())])
    content = describe(path)
    assert json.loads(content["results_of"]) == MANIFEST
    assert counts(content)["/mushpipe/detect"] == ("mushpipe.Circles", 1)


def test_attachments_are_named(tmp_path: Path) -> None:
    import foxglove

    path = tmp_path / "a.mcap"
    with foxglove.open_mcap(path, context=foxglove.Context()) as writer:
        writer.attach(log_time=T0, create_time=T0, name="calib.json", media_type="x", data=b"{}")
    content = describe(path)
    assert content["attachments"] == ["calib.json"]
    assert content["duration_s"] == 0
    assert render(content).splitlines()[1:] == ["attachment calib.json"]


@pytest.mark.parametrize("kept", [0.5, 0.9])
def test_of_a_damaged_file_what_can_be_read_is_counted(kept: float, tmp_path: Path) -> None:
    path = write_foxglove(tmp_path / "f.mcap", 4)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    content = describe(path)
    (damage,) = content["damage"]
    assert damage == "it breaks off: the recorder did not close it, or bytes are missing"
    assert render(content).splitlines()[-1] == f"damaged: {damage}"
    assert 0 < counts(content)[COLOR][1] <= 4
    assert sum(count for _, count in counts(content).values()) < 10


def test_of_a_corrupt_chunk_the_others_are_counted(tmp_path: Path) -> None:
    path = record(tmp_path / "o.mcap", [trace_of(make_frame(i, (320, 240))) for i in range(9)])
    whole = counts(describe(path))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    content = describe(path)
    found = counts(content)
    assert len(content["damage"]) == 1
    assert set(found) == set(whole)
    assert 0 < sum(n for _, n in found.values()) < sum(n for _, n in whole.values())


@pytest.mark.parametrize("content", [b"", b"PNG\r\n\x1a\n12345"])
def test_no_recording_at_all_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError):
        describe(path)


class Side(Enum):
    left = "left"
    right = "right"


class Edge(Group):
    """How an edge is found."""

    width: int | None = Field(None, ge=1, description="width, px")


class Threshold(Stage):
    """Calls bright what is brighter than a level.

    The level is a share of white.
    """

    level: float = Field(0.5, gt=0, le=1, description="share of white")
    band: tuple[int, int] = Field(description="rows, px")
    mode: Literal["fast", "exact"] = Field("fast", description="how")
    side: Side = Field(Side.left, description="where")
    names: list[str] = Field([], description="which")
    edge: Edge = Field(Edge(), description="the edge")

    def process(self, frame: RgbdFrame, mask: Mask | None = None) -> tuple[Mask, Circles]:
        raise NotImplementedError


class Quiet(Sink):
    """Does nothing."""

    def consume(self, circles: Circles) -> None:
        raise NotImplementedError


def registry() -> Registry:
    made = Registry()
    made.stage("threshold", Threshold)
    made.sink("threshold", Quiet)
    made.sink("quiet", Quiet)
    made.sink("quiet", Quiet)
    made.broken.append(Broken("bad", "bad-package", "1.2", "ImportError: no luck"))
    return made


def test_plugins_are_listed_with_their_problems() -> None:
    rows = plugin_rows(registry())
    assert [(r["kind"], r["name"], r["problem"]) for r in rows] == [
        ("stage", "threshold", ""),
        ("sink", "quiet", "the name is taken twice"),
        ("sink", "quiet", "the name is taken twice"),
        ("sink", "threshold", ""),
        ("broken", "bad", "ImportError: no luck"),
    ]
    assert rows[-1]["from"] == "bad-package 1.2"
    lines = render_plugins(rows).splitlines()
    assert lines[0].split() == ["kind", "name", "from", "problem"]
    assert len({line.index("threshold") for line in lines if "threshold" in line}) == 1


def test_every_plugin_of_a_name_is_described() -> None:
    stage, sink = describe_plugin(registry(), "threshold").split("\n\nsink ")
    lines = stage.splitlines()
    assert lines[0] == "stage threshold"
    assert "The level is a share of white." in lines
    assert "inputs   frame: RgbdFrame, mask: Mask (optional)" in lines
    assert "outputs  Mask, Circles" in lines
    assert [re.split(r"  +", line) for line in lines[-8:]] == [
        ["setting", "type", "default", "meaning"],
        ["level", "number > 0 <= 1", "0.5", "share of white"],
        ["band", "[integer, integer]", "required", "rows, px"],
        ["mode", "fast | exact", '"fast"', "how"],
        ["side", "left | right", '"left"', "where"],
        ["names", "list of string", "[]", "which"],
        ["edge", "Edge", "the edge"],
        ["edge.width", "integer >= 1 | null", "null", "width, px"],
    ]
    assert sink.splitlines()[-1] == "outputs  none"


def test_a_plugin_in_a_file_is_described(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "from mushpipe import Mask, Stage\n"
        "class Mine(Stage):\n"
        '    """Mine alone."""\n'
        "    def process(self, mask: Mask) -> Mask:\n"
        "        return mask\n"
    )
    text = describe_plugin(registry(), f"{path}:Mine")
    assert text.startswith(f"stage {path}:Mine\n\nMine alone.\n\ninputs   mask: Mask\n")
    with pytest.raises(PluginError, match="has no class 'Mein'; did you mean 'Mine'"):
        describe_plugin(registry(), f"{path}:Mein")


def test_an_unknown_plugin_gets_a_suggestion() -> None:
    with pytest.raises(PluginError, match="no plugin 'treshold'; did you mean 'threshold'"):
        describe_plugin(registry(), "treshold")
    reason = "it may belong to bad-package 1.2, which failed to load: ImportError: no luck"
    with pytest.raises(PluginError, match=f"there is no plugin 'bad'; .*\n    {reason}$"):
        describe_plugin(registry(), "bad")
