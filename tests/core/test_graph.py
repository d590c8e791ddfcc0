"""Compiling graph files: what a plan holds, and the words for every kind of fault."""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import AfterValidator, ConfigDict, Field, Json, computed_field

from mushpipe import Circles, GraphPath, Mask, RgbdFrame, RunInfo, Sink, SinkPath, Stage
from mushpipe.core.document import Document, parse_document, read_document
from mushpipe.core.errors import GraphError
from mushpipe.core.graph import compile_document
from mushpipe.core.group import Group
from mushpipe.core.plan import Plan
from mushpipe.core.plugins import load_registry
from mushpipe.sinks.mcap import McapSink
from mushpipe.sinks.rerun import RerunSink
from mushpipe.sources.mcap import McapSource
from tests.core.lab import Lab, cli

KEYS = st.sampled_from(
    ["use", "inputs", "level", "band", "delivery", "source", "stages", "sinks", "a", "b", "seed"]
)

GOOD = """
mushpipe: 1
description: a test
seed: 3
on_error: skip
max_failures: 2
source: {use: frames, count: 5}
stages:
  segment: {use: threshold, band: [1, 2]}
  measure: {use: measure}
sinks:
  out: {use: collect, size: 0.5, delivery: latest}
"""


def compiled(text: str) -> Plan:
    """Compile a graph of the plugins that mushpipe brings."""
    return compile_document(parse_document(text, "graph.yaml", Path()), load_registry())


def test_a_good_graph_becomes_a_plan(lab: Lab):
    plan = lab.compile(GOOD)
    assert [node.name for node in plan.stages] == ["segment", "measure"]
    assert plan.source.plugin.count == 5
    assert plan.stages[0].plugin.band == (1, 2)
    assert (plan.seed, plan.on_error, plan.max_failures) == (3, "skip", 2)
    assert plan.sinks[0].delivery == "latest"
    assert plan.warnings == ()
    assert plan.replay()


def test_a_resolved_graph_compiles_to_itself(lab: Lab):
    resolved = lab.compile(GOOD).resolved()
    assert resolved["stages"]["segment"] == {"use": "threshold", "level": 1, "band": [1, 2]}
    assert lab.compile(yaml.safe_dump(resolved, sort_keys=False)).resolved() == resolved


@pytest.mark.parametrize("path", sorted(Path("graphs").glob("*.yaml")), ids=lambda p: p.stem)
def test_the_resolved_form_of_each_graph_here_compiles_to_itself(path: Path):
    """Failure capsules and manifests hold graphs in this form."""
    registry = load_registry()
    resolved = compile_document(read_document(path), registry).resolved()
    again = compile_document(Document("resolved", Path(), resolved), registry)
    assert again.resolved() == resolved


def stage(text: str) -> str:
    return f"mushpipe: 1\nsource: {{use: frames}}\nstages:\n  seg: {text}\n"


FAULTS = {
    "unknown plugin": (
        stage("{use: treshold}"),
        """graph.yaml:4:14: unknown stage 'treshold'; did you mean 'threshold'?
      seg: {use: treshold}
                 ^""",
    ),
    "unknown plugin, nothing near": (
        "mushpipe: 1\nsource: {use: zzz}\n",
        """graph.yaml:2:15: unknown source 'zzz'; known: frames
    source: {use: zzz}
                  ^""",
    ),
    "a plugin of another kind": (
        stage("{use: collect}"),
        """graph.yaml:4:14: 'collect' is a sink, not a stage
      seg: {use: collect}
                 ^""",
    ),
    "misspelt setting": (
        stage("{use: threshold, levle: 3}"),
        """graph.yaml:4:25: unknown setting 'levle' of 'threshold'
      seg: {use: threshold, levle: 3}
                            ^
    did you mean 'level'?""",
    ),
    "a version that only equals 1": (
        "mushpipe: yes\nsource: {use: frames}\n",
        """graph.yaml:1:11: mushpipe: expected 1, the version that this program reads, got true
    mushpipe: yes
              ^""",
    ),
    "wrong type": (
        stage("{use: threshold, level: high}"),
        """graph.yaml:4:32: level of 'threshold': Input should be a valid integer, got "high"
      seg: {use: threshold, level: high}
                                   ^""",
    ),
    "a number in quotes": (
        stage("{use: threshold, level: '3'}"),
        """graph.yaml:4:32: level of 'threshold': Input should be a valid integer, got "3"
      seg: {use: threshold, level: '3'}
                                   ^""",
    ),
    "out of bounds": (
        stage("{use: threshold, level: 300}"),
        """graph.yaml:4:32: level of 'threshold': Input should be less than or equal to 255, got 300
      seg: {use: threshold, level: 300}
                                   ^""",
    ),
    "not finite": (
        "mushpipe: 1\nsource: {use: frames, speed: .inf}\n",
        """graph.yaml:2:30: speed of 'frames': Input should be a finite number, got Infinity
    source: {use: frames, speed: .inf}
                                 ^""",
    ),
    "inside a list": (
        stage("{use: threshold, band: [1, x]}"),
        """graph.yaml:4:35: band.1 of 'threshold': Input should be a valid integer, got "x"
      seg: {use: threshold, band: [1, x]}
                                      ^""",
    ),
    "no use": (
        stage("{level: 3}"),
        """graph.yaml:4:3: needs 'use': the name of a stage
      seg: {level: 3}
      ^""",
    ),
    "no space": (
        stage("{use:threshold}"),
        """graph.yaml:4:3: needs 'use': the name of a stage
      seg: {use:threshold}
      ^
    a space after the colon, as in 'use: name'""",
    ),
    "an entry that is no mapping": (
        stage("invert"),
        "graph.yaml:4:8: stages.seg: expected settings in braces, such as {use: otsu}, "
        """got "invert"
      seg: invert
           ^""",
    ),
    "inputs that are no mapping": (
        stage("{use: threshold, inputs: source}"),
        """graph.yaml:4:33: expected {parameter: stage name}
      seg: {use: threshold, inputs: source}
                                    ^""",
    ),
    "delivery of a stage": (
        stage("{use: threshold, delivery: latest}"),
        """graph.yaml:4:35: expected 'every' or 'latest', on a sink
      seg: {use: threshold, delivery: latest}
                                      ^""",
    ),
    "unknown delivery": (
        "mushpipe: 1\nsource: {use: frames}\nsinks: {out: {use: collect, delivery: some}}\n",
        """graph.yaml:3:39: expected 'every' or 'latest', on a sink
    sinks: {out: {use: collect, delivery: some}}
                                          ^""",
    ),
    "unknown key": (
        "mushpipe: 1\nsorce: {use: frames}\nsource: {use: frames}\n",
        """graph.yaml:2:1: unknown setting 'sorce'
    sorce: {use: frames}
    ^
    did you mean 'source'?""",
    ),
    "missing keys": (
        "stages: {}\n",
        """graph.yaml:1:1: setting 'mushpipe' is missing
    stages: {}
    ^
graph.yaml:1:1: setting 'source' is missing
    stages: {}
    ^""",
    ),
    "the manifest of a run": (
        "graph_file: demo.yaml\ngraph: {mushpipe: 1}\nversions: {}\n",
        "graph.yaml: a run's manifest, and no graph: save what stands in it under 'graph'",
    ),
    "another version": (
        "mushpipe: 2\nsource: {use: frames}\n",
        """graph.yaml:1:11: mushpipe: expected 1, the version that this program reads, got 2
    mushpipe: 2
              ^""",
    ),
    "a name with a space": (
        "mushpipe: 1\nsource: {use: frames}\nsinks: {my out: {use: collect}}\n",
        """graph.yaml:3:9: 'my out' is no name: letters, digits, - and _, beginning with a letter
    sinks: {my out: {use: collect}}
            ^""",
    ),
    "a name that is a key": (
        "mushpipe: 1\nsource: {use: frames}\nsinks: {seed: {use: collect}}\n",
        """graph.yaml:3:9: 'seed' is a key of the graph file and cannot name a stage or sink
    sinks: {seed: {use: collect}}
            ^""",
    ),
    "a sink with the name of a stage": (
        stage("{use: threshold}") + "sinks: {seg: {use: collect}}\n",
        """graph.yaml:5:9: a stage is called 'seg' already
    sinks: {seg: {use: collect}}
            ^""",
    ),
}


@pytest.mark.parametrize("name", ["timing", "total", "T_base_camera"])
def test_names_that_results_use_are_no_stages(lab: Lab, name: str):
    text = f"mushpipe: 1\nsource: {{use: frames}}\nstages:\n  {name}: {{use: threshold}}\n"
    assert f"'{name}' cannot name a stage" in lab.faults(text)


@pytest.mark.parametrize(("text", "expected"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_placed_and_explained(lab: Lab, text: str, expected: str):
    assert lab.faults(text) == expected


@pytest.mark.parametrize("verb", ["run", "validate"])
def test_the_program_prints_the_fault_and_ends_with_2(lab: Lab, monkeypatch, capsys, verb: str):
    text, expected = FAULTS["misspelt setting"]
    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    (lab.folder / "graph.yaml").write_text(text)
    assert cli(monkeypatch, verb, "graph.yaml") == 2
    assert capsys.readouterr() == ("", f"error: {expected}\n")


def test_a_missing_graph_file(lab: Lab, monkeypatch, capsys):
    assert cli(monkeypatch, "run", lab.folder / "no.yaml") == 2
    assert capsys.readouterr().err == f"error: {lab.folder}/no.yaml: there is no such file\n"


def test_all_faults_are_reported_together_in_file_order(lab: Lab):
    text = lab.faults("""
        mushpipe: 1
        source: {use: frame}
        stages:
          a: {use: threshold, level: x, levl: 2}
          b: {use: nothing-like-it}
          c: {use: invert, inputs: 3}
        sinks:
          out: {use: collect, size: -1}
          a: {use: collect}
    """)
    places = [line.split(": ")[0] for line in text.splitlines() if line.startswith("graph.yaml")]
    assert places == [
        f"graph.yaml:{place}" for place in ["2:15", "4:30", "4:33", "5:12", "6:28", "8:29", "9:3"]
    ]


def test_a_faulty_setting_does_not_hide_that_an_input_is_missing(lab: Lab):
    text = lab.faults("""
        mushpipe: 1
        source: {use: frames}
        stages:
          a: {use: threshold, level: x}
          b: {use: invert, inputs: {mask: aa}}
    """)
    assert "4:30: level of 'threshold'" in text
    assert "5:35: there is no stage 'aa'; did you mean 'a'?" in text


def test_a_wrong_word_beside_the_settings_hides_none_of_their_faults(lab: Lab):
    text = lab.faults("""
        mushpipe: 1
        source: {use: frames}
        stages:
          a: {use: threshold, inputs: 3, level: x}
        sinks:
          out: {use: collect, delivery: often, size: -1}
    """)
    places = [line.split(": ")[0] for line in text.splitlines() if line.startswith("graph.yaml")]
    assert places == [f"graph.yaml:{place}" for place in ["4:31", "4:41", "6:33", "6:46"]]


def test_an_unknown_source_does_not_hide_that_an_input_is_missing(lab: Lab):
    text = lab.faults("mushpipe: 1\nsource: {use: frame}\nstages:\n  b: {use: invert}\n")
    assert "2:15: unknown source 'frame'; did you mean 'frames'?" in text
    assert "4:3: nothing above 'b' produces the Mask" in text


def test_a_misspelt_setting_within_a_group_is_told_its_neighbours():
    text = "mushpipe: 1\nsource: {use: synthetic}\nsinks:\n  robot: {use: robot-json, workspace: "
    text += "{low: [0, 0, 0], high: [1, 1, 1], lo: 1}}\n"
    with pytest.raises(GraphError, match=r"4:73: unknown setting 'lo' of 'robot-json'") as raised:
        compiled(text)
    assert "did you mean 'low'?" in str(raised.value)


def test_two_sinks_on_one_file_are_a_fault(lab: Lab):
    lab.registry.sink("mcap", McapSink)
    text = lab.faults("""
        mushpipe: 1
        source: {use: frames}
        sinks:
          a: {use: mcap, path: "x/{recording}.mcap"}
          b: {use: mcap, path: "./x/../x/{recording}.mcap"}
          c: {use: mcap, path: "y/{recording}.mcap"}
    """)
    path = f"{lab.folder.absolute()}/x/{{recording}}.mcap"
    said = f"graph.yaml:5:3: sink 'b' would write over the file of sink 'a', {path}\n"
    assert text.startswith(said)
    assert text.count("would write over") == 1


def test_sinks_may_share_what_is_no_file_of_theirs(lab: Lab):
    class Pages(Sink):
        """A file of its own in a folder."""

        folder: SinkPath

        def files(self, run: RunInfo) -> tuple[Path, ...]:
            return (self.folder / f"{id(self)}.txt",)

        def consume(self) -> None:
            """Take nothing."""

    lab.registry.sink("mcap", McapSink)
    lab.registry.sink("pages", Pages)
    lab.compile("""
        mushpipe: 1
        source: {use: frames}
        sinks:
          a: {use: mcap, path: /dev/null}
          b: {use: mcap, path: /dev/null}
          c: {use: mcap, path: x.mcap}
          d: {use: mcap, path: x.mcap, split_size: 1GB}
          e: {use: pages, folder: pages}
          f: {use: pages, folder: pages}
    """)


def test_a_fault_of_a_plugin_that_the_command_line_chose_says_so(lab: Lab):
    class Needy(Stage):
        size: int

        def process(self, frame: RgbdFrame) -> Mask:
            raise NotImplementedError

    lab.registry.stage("needy", Needy)
    faults = lab.faults(lab.chain("threshold"), "a.use=needy")
    assert "setting 'size' of 'needy' is missing (with --set a.use=needy)" in faults

    class Blind(Stage):
        def process(self, other: Circles) -> Mask:
            raise NotImplementedError

    lab.registry.stage("blind", Blind)
    faults = lab.faults(lab.chain("threshold"), "a.use=blind")
    assert "produces the Circles of its 'other' (with --set a.use=blind)" in faults

    faults = lab.faults(lab.chain("needy, size: large"), "a.use=threshold", "a.use=needy")
    assert 'got "large" (with --set a.use=needy)' in faults


def test_a_missing_setting_is_placed_at_its_plugin(lab: Lab):
    class Needy(Sink):
        size: int

        def consume(self) -> None:
            """Take nothing."""

    lab.registry.sink("needy", Needy)
    assert lab.faults("mushpipe: 1\nsource: {use: frames}\nsinks:\n  out: {use: needy}\n") == (
        "graph.yaml:4:8: setting 'size' of 'needy' is missing\n"
        "      out: {use: needy}\n"
        "           ^"
    )


def test_a_value_that_a_list_lacks_is_counted(lab: Lab):
    class Ranged(Sink):
        span: tuple[float, float]

        def consume(self) -> None:
            """Take nothing."""

    lab.registry.sink("ranged", Ranged)
    graph = "mushpipe: 1\nsource: {use: frames}\nsinks:\n  out: {use: ranged, span: [8]}\n"
    assert "span of 'ranged': value 2 is missing" in lab.faults(graph)


@pytest.mark.parametrize(
    ("given", "faults"),
    [
        (
            "foo",
            ["Input should be 'bed' or 'camera', got \"foo\"", "expected a list in brackets"],
        ),
        ("[1, 2]", ["Input should be 'bed' or 'camera', got [1, 2]", "value 3 is missing"]),
        ("[0, 0, 0]", ["the upright has no direction: a vector needs a component that is not 0"]),
    ],
)
def test_a_setting_of_several_types_is_called_by_its_own_name(given: str, faults: list[str]):
    graph = "mushpipe: 1\nsource: {use: synthetic}\nstages:\n  pose: {use: cap-fit, up: %s}\n"
    with pytest.raises(GraphError) as caught:
        compiled(graph % given)
    lines = [line for line in str(caught.value).splitlines() if "up of 'cap-fit': " in line]
    assert all(any(fault in line for line in lines) for fault in faults)
    assert "function-after" not in str(caught.value)


def test_faults_that_a_plugin_finds_in_its_settings_are_told_before_a_run(lab: Lab):
    lab.registry.sink("mcap", McapSink)
    lab.registry.sink("rerun", RerunSink)
    graph = "mushpipe: 1\nsource: {use: frames}\nsinks:\n"
    assert "'rerun': nothing to do: set 'save'" in lab.faults(graph + "  a: {use: rerun}\n")
    faults = lab.faults(graph + "  a: {use: mcap, path: 'out/{recoding}.mcap'}\n")
    assert "path of 'mcap': {recoding} is not known: only {recording} is" in faults


trees = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["a", "threshold"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=6,
)


@given(st.dictionaries(KEYS, trees), st.sampled_from(["", "a.use=both", "a.level=2", "seed.x=1"]))
def test_any_data_are_a_plan_or_a_graph_error(data, override):
    lab = Lab(Path("/graphs"))
    text = yaml.safe_dump({"mushpipe": 1, "source": {"use": "frames"}, **data})
    try:
        plan = lab.compile(text, *filter(None, [override]))
    except GraphError as error:
        assert error.problems  # noqa: PT017 - a plan is as good
    else:
        assert lab.compile(yaml.safe_dump(plan.resolved(), sort_keys=False))


def test_settings_are_frozen(lab: Lab):
    with pytest.raises(AttributeError, match="settings are frozen"):
        lab.compile(GOOD).stages[0].plugin.level = 4


def test_paths_are_relative_to_the_graph_file_unless_the_shell_gives_them(lab: Lab):
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    graph = "mushpipe: 1\nsource: {use: mcap, path: ../bed.mcap}\n"
    assert lab.compile(graph).source.plugin.path == lab.folder.parent / "bed.mcap"
    given = lab.compile(graph, "source.path=sub/../bed.mcap").source.plugin.path
    assert str(given) == "bed.mcap"
    absolute = lab.compile(graph, "source.path=/data/bed.mcap").source.plugin.path
    assert str(absolute) == "/data/bed.mcap"


def test_the_shell_means_its_own_folder_whatever_a_plugin_calls_the_path_within(lab: Lab):
    class Table(Stage):
        path: GraphPath = Field(alias="file", description="a table")

        def process(self, frame: RgbdFrame) -> Mask: ...

    lab.registry.stage("table", Table)
    graph = "mushpipe: 1\nsource: {use: frames}\nstages: {a: {use: table, file: a.csv}}\n"
    assert lab.compile(graph).stages[0].plugin.path == lab.folder / "a.csv"
    assert str(lab.compile(graph, "a.file=b.csv").stages[0].plugin.path) == "b.csv"


def test_a_tilde_is_the_home_folder_which_no_shell_puts_into_a_setting(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    lab.registry.source("images", "mushpipe.sources.folder:ImagesSource")
    (tmp_path / "photos").mkdir()
    (tmp_path / "mine.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n"
        "class Mine(Stage):\n"
        "    def process(self, frame: RgbdFrame) -> Mask: ...\n"
    )
    graph = "mushpipe: 1\nsource: {use: mcap, path: ~/bed.mcap}\nstages: {a: {use: threshold}}\n"
    plan = lab.compile(graph, "a.use=~/mine.py:Mine")
    assert plan.source.plugin.path == tmp_path / "bed.mcap"
    assert plan.stages[0].use == f"{tmp_path}/mine.py:Mine"
    given = lab.compile(graph, "source.path=~/other.mcap").source.plugin.path
    assert given == tmp_path / "other.mcap"
    assert lab.compile(graph, source="~/photos").source.plugin.path == tmp_path / "photos"
    odd = lab.compile(graph, "source.path=~no-user.mcap").source.plugin.path
    assert str(odd) == "~no-user.mcap"


def test_above_a_link_is_what_it_leads_to_as_in_the_shell(tmp_path: Path) -> None:
    real, link = tmp_path / "station/graphs", tmp_path / "graphs"
    real.mkdir(parents=True)
    link.symlink_to(real)
    for folder, content in ((tmp_path, b"another"), (real.parent, b"the one beside it")):
        (folder / "bed.mcap").write_bytes(content)
    text = "mushpipe: 1\nsource: {use: mcap, path: ../bed.mcap}\n"
    plan = compile_document(parse_document(text, "g.yaml", link), load_registry())
    assert isinstance(plan.source.plugin, McapSource)
    assert plan.source.plugin.path.read_bytes() == b"the one beside it"


@pytest.mark.parametrize("default", [Path("x/{recording}.csv"), "x/{recording}.csv"])
def test_default_paths_are_relative_to_the_graph_file(lab: Lab, default: Path):
    class Rows(Sink):
        path: SinkPath = default

        def consume(self) -> None: ...

    lab.registry.sink("rows", Rows)
    graph = "mushpipe: 1\nsource: {use: frames}\nsinks: {rows: {use: rows}}\n"
    (node,) = lab.compile(graph).sinks
    assert node.plugin.path == lab.folder.absolute() / "x/{recording}.csv"
    assert node.paths == {"path": "x/{recording}.csv"}
    (given,) = lab.compile(graph, "rows.path=y.csv").sinks
    assert given.plugin.path == Path("y.csv")


def test_paths_of_groups_that_are_text_by_default_are_written_out(lab: Lab):
    class Models(Group):
        first: GraphPath = "a.onnx"
        second: GraphPath = Path("b.onnx")

    class Reads(Stage):
        models: Models = Models()

        def process(self, frame: RgbdFrame) -> Mask: ...

    lab.registry.stage("reads", Reads)
    (node,) = lab.compile(lab.chain("reads")).stages
    here = {"first": str(Path("a.onnx").absolute()), "second": str(Path("b.onnx").absolute())}
    assert node.resolved()["models"] == here


class Level(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.color[..., 0] >= self.level)


class Doubled(Level):
    level: int = 1

    @computed_field
    @property
    def double(self) -> int:
        return 2 * self.level


class Encoded(Level):
    level: Json[int] = "1"


class Renamed(Level):
    level: int = Field(1, alias="grey")


class TwoNames(Level):
    model_config = ConfigDict(populate_by_name=True)
    level: int = Field(1, alias="grey")


@pytest.mark.parametrize(
    ("plugin", "text"),
    [
        (Doubled, "level: 2"),
        (Encoded, "level: '2'"),
        (Renamed, "grey: 2"),
        (TwoNames, "grey: 2"),
        (TwoNames, "level: 2"),
    ],
)
def test_settings_of_any_kind_are_the_same_when_written_and_read(lab: Lab, plugin, text):
    lab.registry.stage("level", plugin)
    plan = lab.compile(stage(f"{{use: level, {text}}}"))
    assert plan.stages[0].plugin.level == 2
    again = lab.compile(yaml.safe_dump(plan.resolved()))
    assert again.stages[0].plugin == plan.stages[0].plugin
    assert again.resolved() == plan.resolved()


class ReadByName(Level):
    level: int = Field(1, validation_alias="grey")


class WrittenByName(Level):
    level: int = Field(1, serialization_alias="grey")


class Halved(Level):
    level: Annotated[float, AfterValidator(lambda value: value / 2)]


class Above(Level):
    level: int = 1
    top: int = Field(300, le=255)


class Computed(Level):
    model_config = ConfigDict(arbitrary_types_allowed=True)
    level: int = 1
    kernel: np.ndarray = np.ones(3)


@pytest.mark.parametrize(
    ("plugin", "setting", "fault"),
    [
        (ReadByName, "grey: 2", "'level' is a name for writing alone; an 'alias' is one for both"),
        (WrittenByName, "level: 2", "'grey' is a name for writing alone"),
        (Halved, "level: 2", "level is 1.0 when written, and then read as 0.5"),
        (Above, "level: 2", "top: Input should be less than or equal to 255, got 300"),
        (Computed, "level: 2", "Unable to serialize unknown type: <class 'numpy.ndarray'>"),
    ],
)
def test_settings_that_a_manifest_could_not_hold_are_refused(lab: Lab, plugin, setting, fault):
    lab.registry.stage("level", plugin)
    expected = "graph.yaml:4:14: the settings of 'level' cannot be written into a graph and read "
    text = lab.faults(stage(f"{{use: level, {setting}}}"))
    assert text.startswith(f"{expected}again: {fault}")


def test_a_fault_at_the_top_does_not_hide_the_faults_below() -> None:
    text = (
        "mushpipe: 1\nsede: 3\nsource: {use: synthetic, cuont: 3}\n"
        "stages:\n  a: {use: otsu, x: 1}\n"
    )
    with pytest.raises(GraphError) as caught:
        compile_document(parse_document(text, "g.yaml", Path()), load_registry())
    assert [p.line for p in caught.value.problems] == [2, 3, 5]


def test_numbers_may_be_written_as_powers_of_ten() -> None:
    data = parse_document("a: 1e-3\nb: -2E+4\nc: 1.5e3\nd: 1e\n", "g.yaml", Path()).data
    assert data == {"a": 1e-3, "b": -2e4, "c": 1.5e3, "d": "1e"}


def test_numbers_may_begin_with_their_point() -> None:
    text = "a: [-.1, +.5, .2, -.5e-1, .5E2, -.inf]\nb: [.e, -., .1e, -.1.2]\n"
    data = parse_document(text, "g.yaml", Path()).data
    assert data == {"a": [-0.1, 0.5, 0.2, -0.05, 50, -math.inf], "b": [".e", "-.", ".1e", "-.1.2"]}


@pytest.mark.parametrize(
    ("use", "setting", "value"),
    [
        ("phase-hough", "edge", 1e-300),  # these two wrote beyond an array: the program crashed
        ("phase-hough", "radius_px", "[1.0e-323, 38]"),
        ("chan-vese", "iterations", 10**20),  # these three ran for ever
        ("chan-vese", "smoothing", 10**20),
        ("hough-skimage", "sigma", 1e5),
        ("hough", "min_distance_px", 1e5),  # these two took all memory
        ("cap-net", "radius_px", "[16, 1.0e+15]"),
        ("fuse-depth", "depth_noise_mm", 300),  # in um; surfaces a metre apart were mixed
        ("fuse-depth", "depth_noise_per_m", 1200),
        ("hough", "radius_px", "[8, 1.0e+30]"),  # the others overflowed in the run
        ("hough", "apart", 1e308),
        ("chan-vese", "mu", 1e30),
        ("flatten", "iterations", 10**20),
        ("surface-fit", "circle_sigma_px", 1e300),
        ("onnx", "mean", "[123.675, 116.28, 103.53]"),  # these two made any image a plain one
        ("onnx", "std", "[58.395, 57.12, 57.375]"),
        ("onnx", "std", "[1, 1, 1.0e-300]"),
        ("height", "min_mm", 1e-300),
        ("height", "max_mm", 1e300),
        ("height", "smallest_px", 1e300),
        ("cap-fit", "up", "[1.0e+300, 0, -1.0e+300]"),
        ("registration", "up", "[0, 0, -1.0e-300]"),
    ],
)
def test_a_setting_out_of_all_proportion_is_refused_by_its_name(
    use: str, setting: str, value: object
):
    stages = f"stages:\n  it: {{use: {use}, {setting}: {value}}}\n"
    text = f"mushpipe: 1\nsource: {{use: synthetic}}\n{stages}"
    with pytest.raises(GraphError, match=rf"{setting}(\.\d)? of '{use}': "):
        compiled(text)


@pytest.mark.parametrize("size", ["abc", -5, "2 furlongs"])
def test_a_size_of_files_is_explained(size: object):
    sinks = f"sinks:\n  log: {{use: mcap, path: a.mcap, split_size: {size}}}\n"
    text = f"mushpipe: 1\nsource: {{use: synthetic}}\nstages: {{}}\n{sinks}"
    expected = "split_size of 'mcap': expected a size with its unit, such as 500MB or 2GB, got"
    with pytest.raises(GraphError, match=expected):
        compiled(text)


@pytest.mark.parametrize(
    ("source", "setting"),
    [
        ("mcap, path: bed.mcap, depth_scale: 1000", "depth_scale"),
        ("mcap, path: bed.mcap, depth_scale: 1.0e-300", "depth_scale"),
        ("mcap, path: bed.mcap, start: 1.0e+300", "start"),  # overflowed in `mushpipe view`
        ("images, path: bed, depth: d/*.png, depth_scale: 1000", "depth_scale"),
        ("mcap, path: bed.mcap, camera: {fx: 1.0e+40, fy: 600, cx: 320, cy: 240}", "camera.fx"),
        ("mcap, path: bed.mcap, camera: {fx: 600, fy: 1.0e-40, cx: 320, cy: 240}", "camera.fy"),
        ("realsense, warm_up: 30000", "warm_up"),  # no frame for 17 minutes
        ("realsense, patience_s: 5000", "patience_s"),  # in ms: a lost camera told 83 minutes late
    ],
)
def test_what_no_source_has_is_refused_by_its_name(source: str, setting: str):
    text = f"mushpipe: 1\nsource: {{use: {source}}}\nstages: {{}}\n"
    with pytest.raises(GraphError, match=f"{setting} of '{source.partition(',')[0]}': "):
        compiled(text)
