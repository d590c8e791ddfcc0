"""`--set` and `--source`: what they change, and what they refuse."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from mushpipe import Circles, RgbdFrame, Stage
from mushpipe.core.document import Document, parse_document
from mushpipe.core.graph import compile_document
from mushpipe.core.overrides import apply_override
from mushpipe.core.plugins import load_registry
from tests.core.lab import Frames, Lab, circles, cli

GRAPH = """
mushpipe: 1
seed: 4
source: {use: frames}
stages:
  segment: {use: threshold, level: 7}
  other: {use: invert}
sinks:
  out: {use: collect}
"""


def document() -> Document:
    return parse_document(GRAPH, "graph.yaml", Path())


@pytest.mark.parametrize(
    ("text", "at", "value"),
    [
        ("segment.level=9", ("stages", "segment", "level"), 9),
        ("stages.segment.level=9", ("stages", "segment", "level"), 9),
        ("out.size=2.5", ("sinks", "out", "size"), 2.5),
        ("sinks.out.size=2.5", ("sinks", "out", "size"), 2.5),
        ("source.count=2", ("source", "count"), 2),
        ("seed=5", ("seed",), 5),
        ("max_failures=5", ("max_failures",), 5),
        ("segment.level=", ("stages", "segment", "level"), None),
        ("segment.band=[1, 2]", ("stages", "segment", "band"), [1, 2]),
        ("segment.note=a=b", ("stages", "segment", "note"), "a=b"),
        ("segment.note=[1", ("stages", "segment", "note"), "[1"),
        ("segment.note=2024-05-01", ("stages", "segment", "note"), "2024-05-01"),
        ("out.path=-", ("sinks", "out", "path"), "-"),
        (" segment.level =9", ("stages", "segment", "level"), 9),
        ("segment.new.deep=1", ("stages", "segment", "new", "deep"), 1),
    ],
)
def test_a_value_lands_where_the_path_says(text, at, value):
    changed = document()
    assert apply_override(changed, text) == []
    found = changed.data
    for key in at:
        found = found[key]
    assert found == value
    assert changed.overrides == {at: f"--set {text}"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segment.level", "expected a.b=value"),
        ("segmnt.level=1", "unknown path 'segmnt.level'; did you mean 'segment'?"),
        (
            "seg.use=otsu",
            "unknown path 'seg.use'; NAME.use=... gives a stage or sink of the graph another "
            "plugin; did you mean 'segment'?",
        ),
        (
            "sed.level=1",  # not 'seed', which has no parts
            "unknown path 'sed.level'; known: out, segment, other, source, stages, sinks",
        ),
        ("sed=1", "unknown path 'sed'; did you mean 'seed'?"),
        ("sourc.count=1", "unknown path 'sourc.count'; did you mean 'source'?"),
        ("stages.segmet.level=1", "there is no 'segmet' in stages; did you mean 'segment'?"),
        ("sinks.segment.level=1", "there is no 'segment' in sinks; known: out"),
        ("stages=1", "there is no '' in stages; known: segment, other"),
        ("segment=otsu", "say which setting of 'segment': segment.use=... for example"),
        ("stages.segment=otsu", "say which setting of 'segment': segment.use=... for example"),
        ("source=x", "say which setting of the source: source.path=..., or use --source"),
        ("segment.level.x=1", "'stages.segment.level' has no parts"),
        ("seed.x=1", "'seed' has no parts"),
        ("segment.level=!!bool x", "not a valid bool: 'x'"),
        ("segment.level=!secret x", "the tag '!secret' is not allowed: plain values only"),
        ("segment.level={a: 1, a: 2}", "the key 'a' stands twice"),
        ("segment.level=&a [*a]", "nested too deeply"),
    ],
)
def test_what_is_refused_and_how_it_is_said(text, message):
    changed = document()
    problems = apply_override(changed, text)
    assert [str(problem) for problem in problems] == [f"--set {text}: {message}"]
    assert changed.data == document().data


def test_a_label_of_the_callers_own():
    (problem,) = apply_override(document(), "sorce.speed=1", "--speed 1")
    assert str(problem).startswith("--speed 1: unknown path 'sorce.speed'")


def test_an_option_and_a_change_that_contradict_each_other_are_refused():
    changed = document()
    assert apply_override(changed, "source.count=3", "--frames 3") == []
    (problem,) = apply_override(changed, "source.count=5")
    assert str(problem) == "--set source.count=5: --frames 3 sets this to 3: give one of them"
    assert changed.data["source"]["count"] == 3
    assert apply_override(changed, "source.count=3") == []


def test_what_an_option_only_lifted_may_be_set():
    changed = document()
    assert apply_override(changed, "source.count=null", "--duration 2") == []
    assert apply_override(changed, "source.count=5") == []
    assert changed.data["source"]["count"] == 5


def test_of_two_changes_of_one_setting_the_last_counts():
    changed = document()
    for text in ("source.count=3", "source.count=5"):
        assert apply_override(changed, text) == []
    assert changed.data["source"]["count"] == 5


def test_a_path_into_a_section_that_is_no_mapping():
    broken = parse_document("stages: [1]\n", "graph.yaml", Path())
    (problem,) = apply_override(broken, "stages.segment.level=1")
    assert problem.message == "there is no 'segment' in stages; none is known here"


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False),
    lambda inner: st.lists(inner) | st.dictionaries(st.text("abc", min_size=1), inner),
    max_leaves=8,
)


@given(st.text("ab.=seorucgmnt[]{}!&*:'\" \\Ux0,", max_size=30))
def test_any_text_is_applied_or_refused_and_data_stay_plain(text):
    changed = document()
    if apply_override(changed, text):
        assert changed.data == document().data
    json.dumps(changed.data)


@given(json_values)
def test_json_values_arrive_unchanged(value):
    changed = document()
    # YAML 1.1 wants a point in a number with an exponent, which repr leaves out.
    text = json.dumps(value)
    if "e" in text.replace("true", "").replace("false", ""):
        return
    assert apply_override(changed, f"segment.level={text}") == []
    assert changed.data["stages"]["segment"]["level"] == value


def test_overrides_reach_the_plan_and_are_kept_in_order(lab: Lab):
    plan = lab.compile(GRAPH, "segment.level=9", "seed=8")
    assert plan.stages[0].plugin.level == 9
    assert plan.seed == 8
    assert plan.overrides == ("--set segment.level=9", "--set seed=8")


def test_several_bad_overrides_are_reported_together(lab: Lab):
    text = lab.faults(GRAPH, "segmnt.level=1", "segment.levle=1")
    assert text == (
        "--set segment.levle=1: unknown setting 'levle' of 'threshold'\n"
        "    did you mean 'level'?\n"
        "--set segmnt.level=1: unknown path 'segmnt.level'; did you mean 'segment'?"
    )


def test_another_plugin_drops_the_settings_it_does_not_know(lab: Lab):
    plan = lab.compile(GRAPH, "segment.use=both")
    assert plan.stages[0].use == "both"
    assert "segment: 'both' has no setting 'level'; it is dropped" in plan.warnings


def test_another_plugin_keeps_what_the_command_line_sets_beside_it(lab: Lab):
    text = lab.faults(GRAPH, "segment.use=both", "segment.level=3")
    assert text.startswith("--set segment.level=3: unknown setting 'level' of 'both'")


def test_another_plugin_drops_the_inputs_it_does_not_have(lab: Lab):
    graph = GRAPH.replace("{use: invert}", "{use: invert, inputs: {mask: segment}}")
    assert lab.compile(graph, "other.use=both").stages[1].asked == {}


def test_an_unknown_plugin_on_the_command_line(lab: Lab):
    assert lab.faults(GRAPH, "segment.use=treshold") == (
        "--set segment.use=treshold: unknown stage 'treshold'; did you mean 'threshold'?"
    )


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--set", "segmnt.level=1", "unknown path 'segmnt.level'; did you mean 'segment'?"),
        ("--set", "segment.level", "expected a.b=value"),
        ("--set", "segment.level=x", "level of 'threshold': Input should be a valid integer"),
        ("--frames", "0", "max_frames of 'frames': Input should be greater than or equal to 1"),
    ],
)
def test_the_program_names_the_option_and_ends_with_2(
    lab: Lab, monkeypatch, capsys, option, value, message
):
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    (lab.folder / "graph.yaml").write_text(GRAPH)
    assert cli(monkeypatch, "run", lab.folder / "graph.yaml", option, value) == 2
    assert capsys.readouterr().err.startswith(f"error: {option} {value}: {message}")


def test_source_names_a_recording_or_a_plugin(lab: Lab):
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    plan = lab.compile(GRAPH, source="my/bed.mcap")
    assert (plan.source.use, str(plan.source.plugin.path)) == ("mcap", "my/bed.mcap")
    assert plan.overrides == ("--source my/bed.mcap",)
    assert lab.compile(GRAPH, source="frames").source.use == "frames"
    lab.registry.source("realsense", "mushpipe.sources.realsense:RealsenseSource")
    assert lab.compile(GRAPH, source="my/BED.BAG").source.use == "realsense"


def test_a_folder_with_the_name_of_a_source_is_no_recording(lab: Lab, monkeypatch):
    monkeypatch.chdir(lab.folder)
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    Path("frames").mkdir()
    assert lab.compile(GRAPH, source="frames").source.use == "frames"
    Path("frames").rmdir()
    Path("frames").write_bytes(b"")
    assert str(lab.compile(GRAPH, source="frames").source.plugin.path) == "frames"


def test_source_may_say_whose_plugin_is_meant(lab: Lab):
    assert lab.compile(GRAPH, source="this process:frames").source.use == "this process:frames"
    text = lab.faults(GRAPH, source="another:frames")
    assert text.startswith("--source another:frames: unknown source 'another:frames'")


def test_source_keeps_the_settings_of_the_same_plugin(lab: Lab):
    graph = GRAPH.replace("{use: frames}", "{use: frames, count: 9}")
    assert lab.compile(graph, source="frames").source.plugin.count == 9


def test_source_replaces_one_that_is_broken_or_missing(lab: Lab):
    graph = GRAPH.replace("source: {use: frames}", "source: 7")
    assert lab.compile(graph, source="frames").source.use == "frames"
    graph = GRAPH.replace("source: {use: frames}\n", "")
    assert lab.compile(graph, "source.count=2", source="frames").source.plugin.count == 2


def test_a_setting_goes_by_its_name_in_the_file(lab: Lab):
    class Keyword(Stage):
        global_: int = Field(1, alias="global", description="no name for an attribute")

        def process(self, frame: RgbdFrame) -> Circles:
            return circles(self.global_)

    lab.registry.stage("keyword", Keyword)
    text = lab.chain("threshold").replace("{use: threshold}", "{use: threshold, global: 3}")
    plan = lab.compile(text, "a.use=keyword")
    assert plan.stages[0].plugin.global_ == 3
    assert plan.warnings == ()
    assert "did you mean 'global'?" in lab.faults(lab.chain("keyword"), "a.globl=1")


def test_a_name_that_is_no_utf8_is_told_of(lab: Lab):
    name = os.fsdecode(b"\xff.mcap")
    text = lab.faults(GRAPH, f"source.path={name}")
    assert text == f"--set source.path={name}: this is not UTF-8: give the file another name"
    text = lab.faults(GRAPH, source=name)
    assert text == f"--source {name}: this is not UTF-8: give the file another name"


def test_a_misspelt_source_is_no_recording(lab: Lab):
    graph = "mushpipe: 1\nsource: {use: frames}\n"
    registry = load_registry()
    said = "'framess' is neither a file nor a source; did you mean 'frames'?"
    registry.source("frames", Frames)
    plan = compile_document(parse_document(graph, "g.yaml", Path()), registry, (), "framess")
    assert plan.warnings == (said,)
    plan = compile_document(parse_document(graph, "g.yaml", Path()), registry, (), "bed.mcap")
    assert plan.warnings == ()
    assert plan.overrides == ("--source bed.mcap",)
