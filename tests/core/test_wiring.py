"""Ports read from signatures, and who feeds whom."""

import typing
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import BaseModel

from mushpipe import (
    Circles,
    Columns,
    GraphPath,
    Locations,
    Mask,
    Picks,
    Poses,
    RgbdFrame,
    RunInfo,
    Sink,
    SinkPath,
    Stage,
    Trace,
    column,
)
from mushpipe.core.errors import PluginError
from mushpipe.core.plan import Link
from mushpipe.core.ports import Port, Ports, ports_of
from tests.core.lab import Both, Dice, Frames, Invert, Lab, Threshold


def declared(process: Any) -> type[Stage]:
    return type("Declared", (Stage,), {"process": process})


def optional(self, frame: RgbdFrame, mask: Mask | None, circles: Circles | None = None) -> Mask:
    return Mask(frame.gray > 0)


def old_optional(self, mask: typing.Optional[Mask]) -> Mask:  # noqa: UP045
    return Mask(~mask.foreground)


@pytest.mark.parametrize(
    ("plugin", "ports"),
    [
        (Invert, Ports((Port("mask", Mask, True),), (Mask,))),
        (Both, Ports((Port("frame", RgbdFrame, True),), (Mask, Circles))),
        (Dice, Ports((Port("frame", RgbdFrame, True),), (Circles,), "rng")),
        (Frames, Ports((), (RgbdFrame,))),
        (
            declared(optional),
            Ports(
                (
                    Port("frame", RgbdFrame, True),
                    Port("mask", Mask, False),
                    Port("circles", Circles, False),
                ),
                (Mask,),
            ),
        ),
        (declared(old_optional), Ports((Port("mask", Mask, False),), (Mask,))),
    ],
)
def test_ports_are_read_from_the_signature(plugin, ports):
    assert ports_of(plugin) == ports


def no_annotation(self, frame) -> Mask: ...
def two_types(self, frame: RgbdFrame | Mask) -> Mask: ...
def three_types(self, frame: RgbdFrame | Mask | None) -> Mask: ...
def starred(self, *frames: RgbdFrame) -> Mask: ...
def keyword_only(self, *, frame: RgbdFrame) -> Mask: ...
def positional_only(self, frame: RgbdFrame, /) -> Mask: ...
def no_return(self, frame: RgbdFrame): ...
def none_return(self, frame: RgbdFrame) -> None: ...
def optional_return(self, frame: RgbdFrame) -> Mask | None: ...
def any_number(self, frame: RgbdFrame) -> tuple[Mask, ...]: ...
def anything(self, frame: RgbdFrame) -> Any: ...
def of_anything(self, frame: Any) -> Mask: ...
def selfless(frame: RgbdFrame) -> Mask: ...
def without_any() -> Mask: ...
def two_dice(self, a: np.random.Generator, b: np.random.Generator) -> Mask: ...
async def later(self, frame: RgbdFrame) -> Mask: ...
def twice(self, frame: RgbdFrame) -> tuple[Mask, Mask]: ...
def namesake(self, frame: RgbdFrame) -> type("Circles", (Columns,), {}): ...
def array(self, frame: np.ndarray) -> Mask: ...
def array_return(self, frame: RgbdFrame) -> np.ndarray: ...
def unknown(self, frame: "Frame") -> Mask: ...  # noqa: F821
def unknown_part(self, frame: "np.no_such_thing") -> Mask: ...


def one_by_one(self, frame: RgbdFrame) -> Mask:
    yield Mask(frame.gray > 0)


RETURNS = "Declared.process must be annotated with what it returns: a type, or a tuple of types"


@pytest.mark.parametrize(
    ("process", "message"),
    [
        (no_annotation, "Declared: parameter 'frame' must be annotated with one type"),
        (two_types, "Declared: parameter 'frame' must be annotated with one type"),
        (three_types, "Declared: parameter 'frame' must be annotated with one type"),
        (starred, "Declared: '*frames: "),
        (keyword_only, "Declared: parameter 'frame' must be neither positional-only nor"),
        (positional_only, "Declared: parameter 'frame' must be neither positional-only nor"),
        (no_return, RETURNS),
        (none_return, RETURNS),
        (optional_return, RETURNS),
        (any_number, RETURNS),
        (anything, RETURNS),
        (of_anything, "Declared: parameter 'frame' must be annotated with one type"),
        (selfless, "Declared.process: its first parameter must be 'self'"),
        (without_any, "Declared.process: its first parameter must be 'self'"),
        (two_dice, "Declared: parameter 'b': a stage gets one random generator, a sink none"),
        (later, "Declared.process is 'async', which nobody awaits: make it a plain method"),
        (one_by_one, "Declared.process yields: it must return what it makes of one frame"),
        (twice, "Declared.process returns the same type twice"),
        (namesake, "Declared.process returns a type 'Circles' that is not mushpipe's"),
        (array, "Declared: parameter 'frame' is ndarray, which no stage hands on: write a type of"),
        (array_return, "Declared.process returns ndarray, which no stage hands on: write a type"),
        (unknown, "Declared.process: unknown annotation: name 'Frame' is not defined"),
        (unknown_part, "Declared.process: unknown annotation: module 'numpy' has no attribute"),
    ],
)
def test_a_signature_that_says_too_little(lab: Lab, process, message):
    lab.registry.stage("declared", declared(process))
    fault = lab.faults("mushpipe: 1\nsource: {use: frames}\nstages:\n  a: {use: declared}\n")
    assert fault.startswith(f"graph.yaml:4:12: {message}")


async def consume_later(self, frame: RgbdFrame) -> None: ...
def consume_dice(self, rng: np.random.Generator) -> None: ...


@pytest.mark.parametrize(
    ("consume", "message"),
    [
        (consume_later, "Declared.consume is 'async', which nobody awaits"),
        (consume_dice, "Declared: parameter 'rng': a stage gets one random generator, a sink none"),
    ],
)
def test_a_sink_that_could_not_be_called(consume, message):
    with pytest.raises(PluginError, match=f"^{message}"):
        ports_of(type("Declared", (Sink,), {"consume": consume}))


def table(decorated: bool = True, base: type = Columns, **columns: Any) -> type:
    """Return a type `Table` with fields; those that are no columns are text."""
    hints = {name: str if value == "" else np.ndarray for name, value in columns.items()}
    made = type("Table", (base,), {"__annotations__": hints, **columns})
    return dataclass(frozen=True, eq=False)(made) if decorated else made


@pytest.mark.parametrize(
    ("made", "fault"),
    [
        (table(sequence=column()), "has a field 'sequence', where a recording has that of the"),
        (table(a=column(), timestamp=""), "has a field 'timestamp', where a recording has that"),
        (table(frame_id=column(dtype=int)), "has a field 'frame_id', where a recording has that"),
        (table(a=column(dtype=object)), "has a column 'a' of object, which is not recorded"),
        (table(a=column(dtype=complex)), "has a column 'a' of complex128, which is not recorded"),
        (table(a=column(dtype="U3")), "has a column 'a' of <U3, which is not recorded"),
        (table(a=column(dtype="datetime64[ns]")), "has a column 'a' of datetime64"),
        (table(a=""), r"has no column: declare its fields by column\(\)"),
        (table(a=column(), decorated=False), "is no dataclass: write @dataclass"),
        (table(a=column(), base=Circles, decorated=False), "is no dataclass: write @dataclass"),
    ],
)
def test_a_table_that_could_not_be_recorded(made: type, fault: str):
    def process(self, frame: RgbdFrame) -> made: ...

    with pytest.raises(PluginError, match=f"^Declared.process returns Table, which {fault}"):
        ports_of(declared(process))


@pytest.mark.parametrize(
    "made",
    [
        table(a=column(dtype=str), frame_id=""),
        table(a=column(3, dtype=bool), b=column(dtype=np.uint8)),
        table(a=column(), base=Circles),
        type("Table", (Circles,), {}),
    ],
)
def test_a_table_that_can_be_recorded(made: type):
    def process(self, frame: RgbdFrame) -> made: ...

    assert ports_of(declared(process)).outputs == (made,)


@pytest.mark.parametrize("word", ["use", "inputs", "delivery"])
def test_a_setting_that_a_graph_could_not_set(lab: Lab, word: str):
    class Greedy(Stage):
        __annotations__ = {word: str}

        def process(self, frame: RgbdFrame) -> Mask:
            raise NotImplementedError

    lab.registry.stage("greedy", Greedy)
    fault = lab.faults("mushpipe: 1\nsource: {use: frames}\nstages:\n  a: {use: greedy}\n")
    assert fault.startswith("graph.yaml:4:12: ")
    assert f"Greedy: a setting cannot be called '{word}', which in a graph stands" in fault


class Group(BaseModel):
    out: SinkPath
    more: "list[Group]" = []


class Harmless(BaseModel):
    model: GraphPath
    more: "list[Harmless]" = []


@pytest.mark.parametrize(
    "kind", [list[SinkPath], dict[str, SinkPath] | None, tuple[SinkPath, int], Group, list[Group]]
)
def test_a_path_to_write_that_nobody_would_look_after_is_refused(kind: Any):
    """It could be that of the recording which is played."""

    class Lists(Sink):
        paths: kind

        def consume(self, frame: RgbdFrame) -> None: ...

    with pytest.raises(PluginError, match="'paths' has a SinkPath within another type"):
        ports_of(Lists)


@pytest.mark.parametrize("kind", [SinkPath, SinkPath | None, list[GraphPath], Harmless])
def test_other_paths_are_settings(kind: Any):
    class Writes(Sink):
        path: kind

        def consume(self, frame: RgbdFrame) -> None: ...

    assert ports_of(Writes).inputs


def test_state_made_by_a_constructor_is_refused():
    class Eager(Stage):
        _size: int

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            self._size = 3

        def process(self, frame: RgbdFrame) -> Mask: ...

    with pytest.raises(PluginError, match="Eager has an __init__, without which a run makes its"):
        ports_of(Eager)


def test_a_plugin_without_its_method():
    with pytest.raises(PluginError, match=r"^Stage has no method 'process'$"):
        ports_of(Stage)
    with pytest.raises(PluginError, match=r"^Sink has no method 'consume'$"):
        ports_of(Sink)


def links(lab: Lab, text: str) -> dict[str, dict[str, Link]]:
    plan = lab.compile(text)
    return {node.name: node.links for node in (*plan.stages, *plan.sinks)}


def test_an_input_takes_the_nearest_producer_above_it_through_filters(lab: Lab):
    found = links(lab, lab.chain("brighten", "threshold", "invert", "brighten", "measure"))
    assert found == {
        "a": {"frame": Link("source", 0)},
        "b": {"frame": Link("a", 0)},
        "c": {"mask": Link("b", 0)},
        "d": {"frame": Link("a", 0)},
        "e": {"frame": Link("d", 0), "mask": Link("c", 0)},
        "out": {},
    }


def test_filters_change_what_stages_below_them_see(lab: Lab):
    lab.run(lab.chain("threshold", "invert", "brighten", "measure"))
    # Gray levels 0, 1, 2 plus 100; the inverted mask of level >= 1 is full only for frame 0.
    assert [list(trace.outputs["d"][0].center[0]) for trace in lab.seen] == [
        [100, 48],
        [101, 0],
        [102, 0],
    ]


def test_inputs_name_another_producer(lab: Lab):
    text = lab.chain("threshold", "invert").replace("sinks:", "  c: {use: measure, inputs: {I}}\n#")
    assert links(lab, text.replace("{I}", "{mask: a, frame: source}"))["c"] == {
        "frame": Link("source", 0),
        "mask": Link("a", 0),
    }


def test_the_second_output_of_a_stage_is_wired(lab: Lab):
    class Count(Sink):
        def consume(self, circles: Circles) -> None: ...

    lab.registry.sink("count", Count)
    text = lab.chain("both").replace("collect", "count")
    assert links(lab, text)["out"] == {"circles": Link("a", 1)}


def test_a_subtype_serves_where_its_base_is_wanted(lab: Lab):
    class FineMask(Mask): ...

    class Fine(Stage):
        def process(self, frame: RgbdFrame) -> FineMask: ...

    assert links(lab, lab.chain(Fine, "invert"))["b"] == {"mask": Link("a", 0)}


def test_an_optional_input_may_have_no_producer(lab: Lab):
    found = links(lab, lab.chain(declared(optional), declared(optional)))
    assert found["a"] == {"frame": Link("source", 0)}
    assert found["b"] == {"frame": Link("source", 0), "mask": Link("a", 0)}


def before_circles(self, before: Circles | None, circles: Circles) -> Circles:
    return circles


def two_circles(self, one: Circles | None, two: Circles | None) -> Circles: ...


@pytest.mark.parametrize(
    ("process", "asked", "found"),
    [
        (before_circles, {}, {"circles": "b"}),
        (before_circles, {"before": "a"}, {"circles": "b", "before": "a"}),
        (before_circles, {"before": "b"}, {"circles": "b", "before": "b"}),
        (before_circles, {"circles": "a"}, {"circles": "a"}),
        (two_circles, {}, {"one": "b"}),
        (two_circles, {"two": "a"}, {"two": "a"}),
    ],
)
def test_an_optional_input_beside_another_of_its_type_is_left_open_unless_asked_for(
    lab: Lab, process: Any, asked: dict[str, str], found: dict[str, str]
):
    text = lab.chain("both", "measure", declared(process))
    text = text.replace("own-c}", f"own-c, inputs: {asked}}}".replace("'", ""))
    assert {name: link.producer for name, link in links(lab, text)["c"].items()} == found


def test_a_setting_can_ask_for_an_optional_input_beside_another_of_its_type(lab: Lab):
    stage = declared(before_circles)
    stage.required_inputs = lambda self: frozenset({"before"})  # type: ignore[method-assign]
    found = links(lab, lab.chain("both", stage))
    assert found["b"] == {"circles": Link("a", 1), "before": Link("a", 1)}


def test_an_optional_input_without_producer_is_its_default_or_none(lab: Lab):
    unknown = Poses.unknown(2)
    seen: list[Any] = []

    class Ready(Sink):
        def consume(self, circles: Circles | None) -> None:
            seen.append(circles)

    class Given(Stage):
        def process(self, frame: RgbdFrame, mask: Mask | None, poses: Poses = unknown) -> Mask:  # type: ignore[assignment]
            seen.extend([mask, poses])
            return Mask(frame.gray > 0)

    lab.registry.sink("ready", Ready)
    report = lab.run(lab.chain(Given).replace("collect", "ready"), "source.count=1")
    assert report.error is None
    assert seen == [None, unknown, None]


def test_a_method_may_be_static_or_of_the_class(lab: Lab):
    class Static(Stage):
        @staticmethod
        def process(frame: RgbdFrame) -> Mask:
            return Mask(frame.color[..., 0] > 1)

    class OfClass(Stage):
        @classmethod
        def process(cls, mask: Mask) -> Circles:
            return Circles([[0, 0]], [1 + mask.foreground.sum()], [1])

    assert lab.run(lab.chain(Static, OfClass)).error is None
    assert [trace.outputs["b"][0].radius[0] for trace in lab.seen] == [1, 1, 49]


def test_a_setting_can_make_an_optional_input_a_required_one(lab: Lab):
    class Picky(Stage):
        needs_mask: bool = False

        def required_inputs(self) -> frozenset[str]:
            return frozenset({"mask"} if self.needs_mask else ())

        def process(self, frame: RgbdFrame, mask: Mask | None = None) -> Circles: ...

    text = lab.chain(Picky)
    assert links(lab, text)["a"] == {"frame": Link("source", 0)}
    text = text.replace("a: {", "a: {needs_mask: true, ")
    assert "nothing above 'a' produces the Mask of its 'mask'" in lab.faults(text)


def test_a_missing_setting_is_told_though_it_says_which_inputs_are_required(lab: Lab):
    class Picky(Stage):
        needs_mask: bool

        def required_inputs(self) -> frozenset[str]:
            return frozenset({"mask"} if self.needs_mask else ())

        def process(self, frame: RgbdFrame, mask: Mask | None) -> Circles: ...

    assert "setting 'needs_mask' of 'own-a' is missing" in lab.faults(lab.chain(Picky))


def test_required_inputs_that_fail_are_a_fault(lab: Lab):
    class Broken(Stage):
        def required_inputs(self) -> frozenset[str]:
            raise ValueError("no idea")

        def process(self, frame: RgbdFrame, mask: Mask | None) -> Circles: ...

    fault = lab.faults(lab.chain(Broken))
    assert fault.startswith("graph.yaml:5:3: 'own-a': its required_inputs() failed: ValueError: no")


class Called(Frames):
    name: ClassVar[str] = "bed"


class Known(Frames):
    @property
    def name(self) -> str:
        return "bed"


class Told(Invert):
    def open(self, info: RunInfo) -> None: ...


class Untold(Sink):
    def open(self) -> None: ...
    def consume(self, trace: Trace) -> None: ...


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (Called, "name must be a method that takes (self)"),
        (Known, "name must be a method that takes (self)"),
        (Told, "open must be a method that takes (self)"),
        (Untold, "open must be a method that takes (self, run)"),
    ],
)
def test_what_a_run_calls_must_be_as_it_is_called(plugin, message):
    with pytest.raises(PluginError) as caught:
        ports_of(plugin)
    assert message in str(caught.value)


@pytest.mark.filterwarnings("ignore:Field name:UserWarning")
def test_a_setting_with_the_name_of_a_method():
    class Titled(Frames):
        name: str = "bed"

    with pytest.raises(PluginError, match="a setting cannot be called 'name', as a method of ever"):
        ports_of(Titled)


def test_what_a_run_calls_may_be_static_or_take_more():
    class Easy(Frames):
        @staticmethod
        def name() -> str:
            return "bed"

        @classmethod
        def describe(cls) -> dict[str, Any]:
            return {}

        def open(self, again: bool = False, *more: int) -> None: ...

    assert ports_of(Easy).outputs == (RgbdFrame,)


def test_what_was_found_in_other_circles_is_a_warning(lab: Lab):
    class Locate(Stage):
        def process(self, circles: Circles) -> tuple[Locations, Poses]: ...

    class Fit(Stage):
        def process(self, circles: Circles) -> tuple[Circles, Locations]: ...

    class Pick(Stage):
        def process(self, circles: Circles, locations: Locations, poses: Poses) -> Picks: ...

    def warnings(*stages: str | type[Stage]) -> tuple[str, ...]:
        return lab.compile(lab.chain(*stages)).warnings

    assert warnings("both", Locate, Pick) == warnings("both", Locate, Fit, Locate, Pick) == ()
    mixed = (
        "'d' takes the circles of 'c', and from 'b' the {} of those of 'a': their rows may differ"
    )
    expected = tuple(mixed.format(what) for what in ("locations", "poses"))
    assert warnings("both", Locate, "both", Pick) == expected
    assert len(warnings("both", Locate, Fit, Pick)) == 1  # only the poses are older


def test_an_input_left_open_that_a_stage_above_needs_is_a_warning(lab: Lab):
    class Detect(Stage):
        use_learned: bool = True

        def required_inputs(self) -> frozenset[str]:
            return frozenset({"learned"} if self.use_learned else ())

        def process(self, frame: RgbdFrame, learned: Circles | None = None) -> Circles: ...

    class Fit(Stage):
        def process(self, circles: Circles, learned: Circles | None = None) -> Circles: ...

    lab.registry.stage("fit", Fit)
    said = "'c' goes without 'learned', which 'b' takes from 'a': 'inputs: {learned: a}' gives it"
    text = lab.chain("both", Detect, "fit")
    assert lab.compile(text).warnings == (f"{said} that as well",)
    told = text.replace("{use: fit}", "{use: fit, inputs: {learned: a}}")
    assert lab.compile(told).warnings == ()
    assert lab.compile(lab.chain("both", "fit", "fit")).warnings == ()  # no stage is given any

    class Unlearned(Detect):
        use_learned: bool = False

    assert lab.compile(lab.chain("both", Unlearned, "fit")).warnings == ()


FAULTS = {
    "nobody produces it": (
        "b: {use: invert}",
        """graph.yaml:4:3: nothing above 'b' produces the Mask of its 'mask'
      b: {use: invert}
      ^
    stages that produce Mask: both, invert, threshold""",
    ),
    "only below": (
        "b: {use: measure}\n  c: {use: threshold}",
        """graph.yaml:4:3: nothing above 'b' produces the Mask of its 'mask'
      b: {use: measure}
      ^
    stages that produce Mask: both, invert, threshold""",
    ),
    "it feeds itself": (
        "a: {use: threshold}\n  b: {use: invert, inputs: {mask: b}}",
        """graph.yaml:5:35: a cycle: 'b' feeds itself
      b: {use: invert, inputs: {mask: b}}
                                      ^""",
    ),
    "a cycle": (
        "a: {use: threshold}\n  b: {use: invert, inputs: {mask: c}}\n  c: {use: invert}",
        """graph.yaml:5:35: a cycle: b -> c -> b; 'c' stands below 'b': the order of stages is the data flow
      b: {use: invert, inputs: {mask: c}}
                                      ^""",  # noqa: E501
    ),
    "a wider cycle": (
        "b: {use: invert, inputs: {mask: d}}\n  c: {use: invert}\n"
        "  d: {use: invert, inputs: {mask: c}}",
        """graph.yaml:4:35: a cycle: b -> d -> b; 'd' stands below 'b': the order of stages is the data flow
      b: {use: invert, inputs: {mask: d}}
                                      ^""",  # noqa: E501
    ),
    "wrong order": (
        "b: {use: invert, inputs: {mask: c}}\n  c: {use: threshold}",
        """graph.yaml:4:35: 'c' stands below 'b': the order of stages is the data flow
      b: {use: invert, inputs: {mask: c}}
                                      ^""",
    ),
    "no such stage": (
        "a: {use: threshold}\n  b: {use: invert, inputs: {mask: aa}}",
        """graph.yaml:5:35: there is no stage 'aa'; did you mean 'a'?
      b: {use: invert, inputs: {mask: aa}}
                                      ^""",
    ),
    "the wrong type": (
        "a: {use: threshold}\n  b: {use: invert, inputs: {mask: source}}",
        """graph.yaml:5:35: 'source' does not produce Mask
      b: {use: invert, inputs: {mask: source}}
                                      ^""",
    ),
    "no such input": (
        "a: {use: threshold, inputs: {frme: source}}",
        """graph.yaml:4:32: 'threshold' has no input 'frme'
      a: {use: threshold, inputs: {frme: source}}
                                   ^
    did you mean 'frame'?""",
    ),
}


@pytest.mark.parametrize(("stages", "expected"), FAULTS.values(), ids=FAULTS)
def test_an_input_that_cannot_be_wired(lab: Lab, stages, expected):
    text = f"mushpipe: 1\nsource: {{use: frames}}\nstages:\n  {stages}\n"
    assert lab.faults(text) == expected


def test_inputs_of_a_source_are_refused_in_their_place(lab: Lab):
    fault = lab.faults("mushpipe: 1\nsource: {use: frames, inputs: {mask: a}}\n")
    assert fault.startswith("graph.yaml:2:32: 'frames' has no input 'mask'\n")


def test_all_inputs_that_cannot_be_wired_are_reported_together(lab: Lab):
    text = lab.faults(lab.chain("measure", "invert"))
    assert text.count("nothing above") == 2


def test_a_plugin_that_is_not_known_hides_no_fault_of_others_and_makes_none(lab: Lab):
    """It may produce anything: what it is asked for, and what is found nowhere else."""
    text = lab.faults("""
        mushpipe: 1
        source: {use: frames}
        stages:
          a: {use: nothing-like-it}
          b: {use: invert, inputs: {mask: a}}
          c: {use: invert, inputs: {mask: d}}
          d: {use: measure}
          e: {use: invert, inputs: {maks: a}}
    """)
    lines = [line.split(": ", 1) for line in text.splitlines() if line.startswith("graph.yaml")]
    assert [place for place, _ in lines] == [f"graph.yaml:{at}" for at in ("4:12", "6:35", "8:29")]
    assert "'d' stands below 'c'" in lines[1][1]
    assert "'invert' has no input 'maks'" in lines[2][1]


def finds(made: type) -> type[Stage]:
    def process(self, frame: RgbdFrame) -> made: ...

    return declared(process)


def test_two_tables_of_one_name_are_told_apart(lab: Lab):
    one, other = table(a=column()), table(b=column())

    class Take(Sink):
        def consume(self, found: one) -> None: ...

    lab.registry.sink("take", Take)
    shared = "    plugins share a type that they import from one package, or define in one file"
    said = "graph.yaml:6:3: the Table of 'b' is another type than 'a' has\n      b: {use: own-b}\n"
    assert lab.faults(lab.chain(finds(one), finds(other))) == f"{said}      ^\n{shared}"
    assert lab.compile(lab.chain(finds(one), finds(one))).stages
    fault = lab.faults(lab.chain(finds(other)).replace("collect", "take"))
    assert "nothing above 'out' produces the Table of its 'found'" in fault
    assert fault.endswith(f"'a' has another type of that name: {shared.strip()}")


def test_a_type_that_no_plugin_produces(lab: Lab):
    class Robot(Sink):
        def consume(self, picks: Picks) -> None: ...

    lab.registry.sink("robot", Robot)
    lab.registry.stage("broken", "no_such_module:X")
    text = "mushpipe: 1\nsource: {use: frames}\nsinks:\n  r: {use: robot}\n"
    assert lab.faults(text).endswith("stages that produce Picks: none installed")


def test_of_a_name_that_two_packages_have_both_ways_to_write_it_are_told(lab: Lab):
    lab.registry._owner = ("fungus", "1.2")
    lab.registry.stage("threshold", Threshold)
    hint = "stages that produce Mask: both, invert, this process:threshold, fungus:threshold"
    assert hint in lab.faults(lab.chain("invert"))


def test_a_stage_that_lacks_its_library_does_not_hide_the_fault(lab: Lab, monkeypatch):
    from mushpipe.core.errors import DependencyError
    from mushpipe.core.plugins import Entry

    def load(entry: Entry) -> type:
        raise DependencyError("no libGL")

    lab.registry.stage("heavy", "heavy:Heavy")
    own = Entry.load
    monkeypatch.setattr(Entry, "load", lambda e: load(e) if e.name == "heavy" else own(e))
    assert "stages that produce Mask: both, invert, threshold" in lab.faults(lab.chain("invert"))


def test_an_output_that_nobody_takes_is_a_warning(lab: Lab):
    class Count(Sink):
        def consume(self, circles: Circles) -> None: ...

    lab.registry.sink("count", Count)
    text = lab.chain("threshold", "both").replace("collect", "count")
    assert lab.compile(text).warnings == ("nobody takes what 'a' produces",)


def test_a_sink_that_records_everything_takes_every_output(lab: Lab):
    assert lab.compile(lab.chain("threshold", "both")).warnings == ()
    assert Trace in {p.type for p in lab.compile(lab.chain("both")).sinks[0].ports.inputs}


def test_everything_that_stages_found_comes_from_no_stage_alone(lab: Lab):
    fault = lab.faults(
        "mushpipe: 1\nsource: {use: frames}\nstages:\n  a: {use: threshold}\n"
        "sinks:\n  out: {use: collect, inputs: {trace: a}}\n"
    )
    assert fault == (
        "graph.yaml:6:32: 'trace' of 'collect' is everything that all stages found\n"
        "      out: {use: collect, inputs: {trace: a}}\n"
        "                                   ^\n"
        "    leave it out"
    )
