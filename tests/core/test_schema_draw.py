"""The JSON Schema of graph files, and graphs drawn as text."""

import re
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from pydantic import ConfigDict, Field

from mushpipe import Mask, RgbdFrame, Stage
from mushpipe.core.draw import dot, mermaid
from mushpipe.core.plugins import load_registry
from mushpipe.core.schema import graph_schema
from mushpipe.info import describe_plugin
from tests.core.lab import Frames, Lab
from tests.core.test_graph import GOOD

GRAPHS = sorted((Path(__file__).parents[2] / "graphs").glob("*.yaml"))


def check(lab: Lab, text: str) -> None:
    jsonschema.validate(yaml.safe_load(text), graph_schema(lab.registry))


def test_the_schema_is_a_schema(lab: Lab):
    jsonschema.Draft7Validator.check_schema(graph_schema(lab.registry))


def test_the_schema_takes_a_good_graph(lab: Lab):
    check(lab, GOOD)


@pytest.mark.parametrize("path", GRAPHS, ids=lambda path: path.stem)
def test_the_schema_takes_the_graphs_of_the_project(path):
    jsonschema.validate(yaml.safe_load(path.read_text()), graph_schema(load_registry()))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mushpipe: 1", "mushpipe: 2", "1 was expected"),
        ("seed: 3", "sead: 3", "'sead' was unexpected"),
        ("on_error: skip", "on_error: stop", "'stop' is not one of ['fail', 'skip']"),
        ("count: 5", "count: -5", "-5 is less than the minimum of 0"),
        ("count: 5", "cuont: 5", "'cuont' was unexpected"),
        ("band: [1, 2]", "band: [1]", "[1] is too short"),
        ("band: [1, 2]", "levle: 3", "'levle' was unexpected"),
        ("use: threshold", "use: treshold", "'treshold' is not valid under any"),
        ("delivery: latest", "delivery: some", "'some' is not one of ['every', 'latest']"),
        ("use: measure", "us: measure", "'use' is a required property"),
    ],
)
def test_the_schema_refuses_what_the_compiler_refuses(lab: Lab, old, new, message):
    broken = GOOD.replace(old, new)
    with pytest.raises(jsonschema.ValidationError, match=re.escape(message)):
        check(lab, broken)
    lab.faults(broken)


def test_a_stage_in_a_file_passes_the_schema(lab: Lab):
    check(lab, lab.chain("./mine.py:Mine", "other-package:name"))


def test_definitions_of_nested_settings_are_found(lab: Lab):
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    graph = "mushpipe: 1\nsource: {use: mcap, path: x, camera: {fx: %s, fy: 1, cx: 1, cy: 1}}\n"
    check(lab, graph % 5)
    with pytest.raises(jsonschema.ValidationError):
        check(lab, graph % -5)


def test_plugins_that_cannot_be_imported_are_left_out(lab: Lab):
    lab.registry.stage("broken", "no_such_module:X")
    schema = graph_schema(lab.registry)
    names = schema["properties"]["stages"]["additionalProperties"]["properties"]["use"]["anyOf"][0]
    assert "broken" not in names["enum"]
    assert "threshold" in names["enum"]


def test_a_setting_that_json_has_no_word_for_may_be_anything(lab: Lab):
    class Fine(Stage):
        model_config = ConfigDict(arbitrary_types_allowed=True)
        kernel: np.ndarray | None = Field(None, description="made by the stage")
        level: int = Field(1, ge=0, description="gray level")

        def process(self, frame: RgbdFrame) -> Mask: ...

    lab.registry.stage("fine", Fine)
    graph = lab.chain("fine")
    check(lab, graph)
    with pytest.raises(jsonschema.ValidationError, match="less than the minimum of 0"):
        check(lab, graph.replace("fine}", "fine, level: -1}"))
    described = describe_plugin(lab.registry, "fine").splitlines()
    assert [line.split() for line in described[-2:]] == [
        ["kernel", "any", "|", "null", "null", "made", "by", "the", "stage"],
        ["level", "integer", ">=", "0", "1", "gray", "level"],
    ]


def test_mermaid(lab: Lab):
    assert mermaid(lab.compile(lab.chain("threshold", "measure"))) == (
        "flowchart TD\n"
        '  n0(["source<br/><small>frames</small>"])\n'
        '  n1["a<br/><small>threshold</small>"]\n'
        '  n2["b<br/><small>measure</small>"]\n'
        '  n3[/"out<br/><small>collect, every</small>"/]\n'
        "  n0 -->|RgbdFrame| n1\n"
        "  n0 -->|RgbdFrame| n2\n"
        "  n1 -->|Mask| n2\n"
        "  n2 -.->|everything| n3"
    )


def test_dot(lab: Lab):
    assert dot(lab.compile(lab.chain("threshold"))) == (
        "digraph mushpipe {\n"
        '  "source" [shape=oval, label="source\\nframes"];\n'
        '  "a" [shape=box, label="a\\nthreshold"];\n'
        '  "out" [shape=parallelogram, label="out\\ncollect, every"];\n'
        '  "source" -> "a" [label="RgbdFrame"];\n'
        '  "a" -> "out" [label="everything", style=dashed];\n'
        "}"
    )


def test_drawing_asks_nothing_of_a_source_that_is_not_open(lab: Lab):
    class Device(Frames):
        _link: Any = None

        @property
        def live(self) -> bool:
            return self._link.live

    lab.registry.source("device", Device)
    text = lab.chain("threshold", source="device")
    assert "collect, every" in mermaid(lab.compile(text))
    assert "collect, latest" in dot(lab.compile(text, "out.delivery=latest"))


def test_the_second_output_is_labelled_with_its_own_type(lab: Lab):
    from mushpipe import Circles, Sink

    class Count(Sink):
        def consume(self, circles: Circles) -> None: ...

    lab.registry.sink("count", Count)
    assert "n1 -->|Circles| n2" in mermaid(
        lab.compile(lab.chain("both").replace("collect", "count"))
    )
