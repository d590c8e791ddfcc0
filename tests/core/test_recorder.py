"""Writing recordings: what happens when no more can be written."""

from __future__ import annotations

from pathlib import Path

import pytest

from mushpipe.core.errors import UsageError
from mushpipe.core.recorder import RecordingError, RecordingWriter
from mushpipe.core.recording import RecordingReader
from mushpipe.core.wire import COLOR_TOPIC, json_message, json_schema
from tests.io.values import make_frame

SIZE = (160, 120)


class Disk:
    """A file on a disk that is full for a while."""

    def __init__(self, path: Path, room: int) -> None:
        self.file = path.open("wb", buffering=0)
        self.room = room

    def write(self, data: memoryview) -> int:
        if not self.room:
            raise OSError(28, "No space left on device")
        written = self.file.write(data[: self.room])
        self.room -= written
        return written

    def close(self) -> None:
        self.file.close()


@pytest.mark.parametrize("room", [1_300_000, 2_345_678])
def test_after_a_full_disk_nothing_is_written_even_when_there_is_room_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """What follows a torn chunk could not be read; so the file ends with it."""
    path = tmp_path / "out.mcap"
    disk = Disk(path, room)
    monkeypatch.setattr("mushpipe.core.recorder._create", lambda *_: disk)
    writer = RecordingWriter(path, {"note": {"a": "b"}})
    written = 0

    def record() -> None:
        nonlocal written
        while True:
            writer.frame(make_frame(written, SIZE))
            written += 1

    with pytest.raises(RecordingError) as caught:
        record()
    told = f"{path}: No space left on device; it plays up to its last whole chunk"
    assert str(caught.value) == f"{told}; make room, or record elsewhere"
    disk.room = 10**9
    for _ in range(3):
        with pytest.raises(RecordingError, match="No space left"):
            writer.metadata("more", {})
    writer.close()
    assert disk.file.closed
    assert path.stat().st_size == room
    reader = RecordingReader(path)
    frames = sum(raw.channel.topic == COLOR_TOPIC for raw in reader.messages())
    assert 0 < frames <= written + 1
    assert reader.damage == ["it breaks off: the recorder did not close it, or bytes are missing"]


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"cannot be written: Is a directory"):
        RecordingWriter(tmp_path, {})


def test_a_file_that_another_writer_has_open_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    writer = RecordingWriter(path, {})
    writer.frame(make_frame(size=SIZE))
    with pytest.raises(UsageError, match="is being written by another run"):
        RecordingWriter(path, {})
    writer.close()
    reader = RecordingReader(path)
    assert reader.index().counts[COLOR_TOPIC] == 1
    assert not reader.damage
    RecordingWriter(path, {}).close()  # the run is over
    assert not RecordingReader(path).index().counts


def test_a_file_that_is_not_to_be_written_over_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    RecordingWriter(path, {}, overwrite=False).close()
    before = path.read_bytes()
    with pytest.raises(UsageError, match=r"out\.mcap exists already: give the recording another"):
        RecordingWriter(path, {}, overwrite=False)
    assert path.read_bytes() == before


def test_types_of_one_name_keep_their_own_schemas(tmp_path: Path) -> None:
    """Two plugins may both call a table Marks; on one topic, a recording may hold two versions."""
    header, path = make_frame(size=SIZE).header, tmp_path / "out.mcap"
    schemas = [json_schema("mushpipe.Marks", {name: {"type": "integer"}}) for name in "xy"]
    writer = RecordingWriter(path, {})
    for topic, schema in zip(("/a", "/b", "/a"), (*schemas, schemas[1]), strict=True):
        writer.write(topic, json_message(schema, header, {}), header)
    writer.close()
    stored = [(raw.channel.topic, raw.schema) for raw in RecordingReader(path).messages()]
    assert [(topic, schema and schema.data) for topic, schema in stored] == [
        ("/a", schemas[0].data),
        ("/b", schemas[1].data),
        ("/a", schemas[1].data),
    ]
