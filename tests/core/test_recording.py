"""The MCAP reader on files of its own and on files that are not what they seem."""

import gzip
import os
import struct
from pathlib import Path

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recording import RecordingReader

MAGIC = b"\x89MCAP0\r\n"


def write(path: Path, **options) -> Path:
    """Ten messages on two topics, by the MCAP library alone; every one in its own chunk."""
    writer = Writer(str(path), chunk_size=1, compression=CompressionType.NONE, **options)
    writer.start()
    schema = writer.register_schema("mine", "jsonschema", b"{}")
    channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
    bare = writer.register_channel("/bare", "json", 0)
    writer.add_metadata("note", {"a": "b"})
    writer.add_attachment(0, 0, "picture", "image/png", b"...")
    for i in range(10):
        writer.add_message(channels[i % 2], log_time=10 + i, data=b"{}", publish_time=i)
    writer.add_message(bare, log_time=20, data=b"{}", publish_time=0)
    writer.finish()
    return path


def times(reader: RecordingReader, *arguments) -> list[int]:
    return [raw.message.log_time for raw in reader.messages(*arguments)]


@pytest.mark.parametrize(
    "options",
    [{}, {"use_statistics": False}, {"index_types": IndexType.NONE}, {"enable_crcs": False}],
    ids=["whole", "no statistics", "no index", "no checksums"],
)
def test_the_index_is_the_same_from_summary_and_from_reading(tmp_path, options):
    reader = RecordingReader(write(tmp_path / "x.mcap", **options))
    index = reader.index()
    assert index.counts == {"/a": 5, "/b": 5, "/bare": 1}
    assert (index.start_ns, index.end_ns) == (10, 20)
    assert index.schema_name("/a") == "mine"
    assert index.schema_name("/bare") == ""
    assert set(index.channels) == {"/a", "/b", "/bare"}
    assert (index.metadata, index.attachments) == ({"note": {"a": "b"}}, ["picture"])
    assert times(reader) == list(range(10, 21))
    assert times(reader, {"/b"}, 12, 16) == [13, 15]
    assert times(reader, None, 12, 16) == [12, 13, 14, 15]
    assert times(reader, None, 18) == [18, 19, 20]
    assert times(reader, None, 0, 12) == [10, 11]
    assert reader.damage == []
    assert reader.index() is index


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"MThd\0\0\0\6\0", "not an MCAP file (it begins with b'MThd\\x00\\x00\\x00\\x06')"),
        (MAGIC[:4], "not an MCAP file (it begins with b'\\x89MCA')"),
        (
            gzip.compress(MAGIC, mtime=0),
            "not an MCAP file (it is compressed as a whole: 'gunzip FILE' unpacks it)",
        ),
        (b"PK\3\4" + MAGIC, "not an MCAP file (it is a zip archive: 'unzip FILE' unpacks it)"),
    ],
)
def test_a_file_that_is_no_recording(tmp_path, content, message):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        RecordingReader(path)
    assert str(caught.value) == f"{path}: {message}"
    assert caught.value.exit_code == 4


def test_a_file_that_is_not_there_or_a_folder(tmp_path):
    with pytest.raises(UsageError) as caught:
        RecordingReader(tmp_path / "x.mcap")
    assert str(caught.value) == f"{tmp_path}/x.mcap: there is no such recording"
    with pytest.raises(UsageError) as caught:
        RecordingReader(tmp_path)
    assert str(caught.value) == f"{tmp_path}: it is a folder, in which no recording is"
    for name in ("bag_0.db3", "bag_0.mcap"):  # what SQLite holds, its own message tells
        (tmp_path / name).touch()
        with pytest.raises(UsageError) as caught:
            RecordingReader(tmp_path)
        assert str(caught.value).endswith(f"a recording is a file: {tmp_path}/{name}")


def records(data: bytes) -> list[tuple[int, int, int]]:
    """Return (opcode, begin, end) of every record; each is opcode, uint64 length, content."""
    at, found = len(MAGIC), []
    while at < len(data) - len(MAGIC):
        (length,) = struct.unpack_from("<Q", data, at + 1)
        found.append((data[at], at, at + 9 + length))
        at += 9 + length
    return found


def chunks(data: bytes) -> list[tuple[int, int]]:
    return [(begin, end) for opcode, begin, end in records(data) if opcode == 6]


def test_a_pipe_is_no_damaged_file(tmp_path):
    """`mushpipe info <(zstd -dc bed.mcap.zst)`: nothing is read of it, and nobody waits."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match=r"pipe: it is a pipe, .* save it as a file"):
        RecordingReader(tmp_path / "pipe")


def test_a_recording_cut_short_is_read_up_to_the_cut(tmp_path):
    path = write(tmp_path / "x.mcap")
    data = path.read_bytes()
    path.write_bytes(data[: chunks(data)[4][1] - 3])
    reader = RecordingReader(path)
    assert times(reader) == [10, 11, 12, 13]
    assert reader.damage == ["it breaks off: the recorder did not close it, or bytes are missing"]
    assert reader.index().counts == {"/a": 2, "/b": 2}


@pytest.mark.parametrize(
    ("ending", "damage"),
    [
        (b"", "it breaks off: the recorder did not close it, or bytes are missing"),
        (bytes(8), "its last bytes are missing"),
    ],
)
def test_only_the_magic_at_the_end_is_lost(tmp_path, ending, damage):
    path = write(tmp_path / "x.mcap")
    path.write_bytes(path.read_bytes()[:-8] + ending)
    reader = RecordingReader(path)
    assert len(times(reader)) == 11
    assert damage in reader.damage


def test_a_corrupt_chunk_is_left_out_and_the_others_are_read(tmp_path):
    path = write(tmp_path / "x.mcap")
    data = bytearray(path.read_bytes())
    data[chunks(data)[3][1] - 1] ^= 0xFF
    path.write_bytes(data)
    reader = RecordingReader(path)
    assert times(reader) == [10, 11, 12, *range(14, 21)]
    (damage,) = reader.damage
    assert damage.startswith("a chunk is corrupt (")


def test_a_chunk_that_claims_to_be_huge_is_left_out(tmp_path):
    path = write(tmp_path / "x.mcap")
    data = bytearray(path.read_bytes())
    begin, _ = chunks(data)[3]
    # opcode, length, first and last time, then the size when unpacked
    struct.pack_into("<Q", data, begin + 9 + 16, 2**40)
    path.write_bytes(data)
    reader = RecordingReader(path)
    assert 13 not in times(reader)
    assert reader.damage == ["a chunk is corrupt (implausible size)"]


def test_chunks_that_are_missing_are_noticed(tmp_path):
    path = write(tmp_path / "x.mcap")
    data = path.read_bytes()
    begin, end = chunks(data)[3]
    # The summary knows of the message, the data section does not; offsets are kept by padding.
    padding = bytes([0xF0]) + struct.pack("<Q", end - begin - 9) + bytes(end - begin - 9)
    path.write_bytes(data[:begin] + padding + data[end:])
    reader = RecordingReader(path)
    assert 13 not in times(reader)
    assert reader.damage == ["1 of its messages are missing"]


def test_a_corrupt_summary_is_noticed_and_not_trusted(tmp_path):
    path = write(tmp_path / "x.mcap")
    data = bytearray(path.read_bytes())
    last = records(data)[-3]
    data[last[2] - 1] ^= 0xFF
    path.write_bytes(data)
    reader = RecordingReader(path)
    assert reader.index().counts == {"/a": 5, "/b": 5, "/bare": 1}
    assert reader.damage == ["its index is corrupt"]


def test_a_message_of_no_channel_is_noticed(tmp_path):
    path = tmp_path / "x.mcap"
    body = struct.pack("<HIQQ", 9, 0, 5, 5) + b"{}"
    header = bytes([1]) + struct.pack("<Q", 8) + bytes(8)
    path.write_bytes(MAGIC + header + bytes([5]) + struct.pack("<Q", len(body)) + body)
    reader = RecordingReader(path)
    assert times(reader) == []
    assert "a message belongs to no channel" in reader.damage


def topic_by_topic(path: Path, *logged: tuple[str, int], each: int = 2) -> Path:
    """Messages in this order, ``each`` to a chunk."""
    writer = Writer(str(path), compression=CompressionType.NONE)
    writer.start()
    channels = {topic: writer.register_channel(topic, "json", 0) for topic, _ in logged}
    for number, (topic, time) in enumerate(logged, 1):
        writer.add_message(channels[topic], log_time=time, data=b"{}", publish_time=time)
        if number % each == 0:
            writer.flush()
    writer.finish()
    return path


@pytest.mark.parametrize("each", [1, 2, 3, 7])
def test_messages_come_by_time_where_chunks_hold_one_topic_after_the_other(tmp_path, each):
    """Colour and depth do not find each other where all of one comes before all of the other."""
    logged = [("/a", 10 + 2 * i) for i in range(10)] + [("/b", 11 + 2 * i) for i in range(10)]
    reader = RecordingReader(topic_by_topic(tmp_path / "x.mcap", *logged, each=each))
    assert times(reader) == list(range(10, 30))
    assert times(reader, {"/b"}, 12, 16) == [13, 15]
    assert [raw.message.log_time for raw in reader.messages(as_written=True)] == times(reader)
    assert reader.damage == []


def test_messages_of_one_time_come_in_the_order_of_the_file(tmp_path):
    logged = [("/a", 1), ("/a", 5), ("/b", 1), ("/b", 5), ("/c", 5), ("/c", 5)]
    reader = RecordingReader(topic_by_topic(tmp_path / "x.mcap", *logged))
    found = [(raw.channel.topic, raw.message.log_time) for raw in reader.messages()]
    assert found == [("/a", 1), ("/b", 1), ("/a", 5), ("/b", 5), ("/c", 5), ("/c", 5)]


def test_where_a_clock_was_set_back_the_order_of_the_file_stays(tmp_path):
    logged = [("/a", 10), ("/b", 11), ("/a", 20), ("/b", 21), ("/a", 12), ("/b", 13)]
    reader = RecordingReader(topic_by_topic(tmp_path / "x.mcap", *logged))
    assert times(reader) == [10, 11, 20, 21, 12, 13]


def test_a_corrupt_chunk_among_such_is_left_out_and_the_others_are_read(tmp_path):
    logged = [("/a", 10), ("/a", 12), ("/b", 11), ("/b", 13)]
    path = topic_by_topic(tmp_path / "x.mcap", *logged)
    data = bytearray(path.read_bytes())
    _, end = chunks(bytes(data))[0]
    data[end - 3] ^= 1
    path.write_bytes(data)
    reader = RecordingReader(path)
    assert times(reader) == [11, 13]
    assert [text for text in reader.damage if text.startswith("a chunk is corrupt")]
