"""Golden results: what every recording gives, kept beside the tests.

    python -m tests.proof.goldens          # make them anew, showing what changes

A golden holds the tables and masks of the first frames, not the images.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from mushpipe.core import wire
from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plan import Plan
from mushpipe.core.plugins import load_registry
from mushpipe.core.run import run
from mushpipe.proof.compare import Comparison, compare

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "goldens"
# Other processors round otherwise; seen so far: masks in a few pixels, lengths by 1e-7 m and, of
# one circle, 1.5e-3 px, axes and scores by 1e-5. This is above that, and well below what a robot
# notices.
TOLERANCE = 1e-3
METRES = ("position", "surface", "apex", "distance", "diameter", "sigma_position", "sigma_diameter")
LIMITS = {**dict.fromkeys(METRES, 2e-5), **dict.fromkeys(("center", "radius"), 4e-3)}
GRAPHS = {
    "pick": ROOT / "graphs/pick.yaml",
    "classic": ROOT / "graphs/classic.yaml",
    "baisa2022": ROOT / "graphs/baisa2022.yaml",
    "every": ROOT / "tests/proof/every.yaml",
}
RECORDINGS = sorted(path.stem for path in (ROOT / "recordings").glob("*.mcap"))


@dataclass(frozen=True)
class Case:
    """A graph on the first frames of a recording."""

    graph: str
    recording: str
    frames: int

    def __str__(self) -> str:
        return f"{self.graph}.{self.recording}"

    @property
    def golden(self) -> Path:
        """Where its results are kept."""
        return FOLDER / f"{self}.mcap"

    def plan(self, log: Path) -> Plan:
        """Return what makes its results."""
        source = ROOT / f"recordings/{self.recording}.mcap"
        overrides = [f"source.max_frames={self.frames}", f"log.path={log}"]
        document = read_document(GRAPHS[self.graph])
        return compile_document(document, load_registry(), overrides, str(source))

    def make(self, path: Path) -> None:
        """Run it and keep its tables and masks."""
        log = path.with_suffix(".log.mcap")
        report = run(self.plan(log))
        if report.exit_code:
            raise RuntimeError(f"{self}: {report.error}")
        keep_tables(log, path)
        log.unlink()


CASES = [
    *(Case("pick", recording, 2) for recording in RECORDINGS),
    *(Case("classic", recording, 1) for recording in ("first-bed", "gaps", "harsh-light", "lab")),
    Case("baisa2022", "first-bed", 1),
    Case("every", "first-bed", 2),
]


def keep_tables(log: Path, path: Path) -> None:
    """Copy what is no image of a camera, in the order it stands in."""
    with log.open("rb") as source, path.open("wb") as target:
        writer = Writer(target, compression=CompressionType.ZSTD)
        writer.start(profile="mushpipe", library="mushpipe")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if schema is None or not _is_result(schema.name, channel.topic):
                continue
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known, dict(channel.metadata)
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        writer.finish()


def _is_result(schema: str, topic: str) -> bool:
    if not topic.startswith(wire.RESULT_PREFIX) or topic == wire.TIMING_TOPIC:
        return False
    mask = schema == "foxglove.RawImage" and not topic.endswith(("/color", "/depth"))
    return mask or schema.startswith("mushpipe.")


def renewed(case: Case, path: Path) -> Comparison:
    """Make a case anew and return how it differs from its golden."""
    case.make(path)
    return compare(case.golden, path, TOLERANCE, limits=LIMITS)


def main() -> None:
    """Make all goldens anew."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES:
            new = Path(folder) / f"{case}.mcap"
            if case.golden.exists():
                found = renewed(case, new)
                for d in found.differences:
                    sys.stdout.write(f"{case} frame {d.sequence} {d.topic} {d.field}: {d.text}\n")
            else:
                case.make(new)
                sys.stdout.write(f"{case} is new\n")
            case.golden.write_bytes(new.read_bytes())
    for path in set(FOLDER.glob("*.mcap")) - {case.golden for case in CASES}:
        path.unlink()


if __name__ == "__main__":
    main()
