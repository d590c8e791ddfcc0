"""Reading YAML: places of keys and values, and everything that is refused."""

import json
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from mushpipe.core.document import Document, parse_document, read_document
from mushpipe.core.errors import GraphError

HERE = Path("/graphs")


def parse(text: str):
    return parse_document(text, "g.yaml", HERE)


def refused(text: str) -> str:
    with pytest.raises(GraphError) as caught:
        parse(text)
    assert caught.value.exit_code == 2
    return str(caught.value)


def test_of_what_is_too_large_for_a_graph_no_more_is_read(tmp_path: Path):
    """A recording that is given as a graph is larger than the memory of many a computer."""
    recording = tmp_path / "bed.bag"
    with recording.open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(GraphError, match=r"bed\.bag: it has more than 2 MB: .*--source"):
        read_document(recording)


def test_places_of_keys_and_values_count_from_one():
    document = parse("a: 1\nb:\n  c: [x, {d: 2.5}]\n")
    assert document.data == {"a": 1, "b": {"c": ["x", {"d": 2.5}]}}
    assert document.keys[("b", "c")] == (3, 3)
    assert document.values[("b", "c", 0)] == (3, 7)
    assert document.keys[("b", "c", 1, "d")] == (3, 11)
    assert document.values[("b", "c", 1, "d")] == (3, 14)


BROKEN = {
    "merge key": (
        "a: &a {c: 1}\nb: {<<: *a, d: 2}\n",
        """g.yaml:2:5: a merge key (<<) is not known here
    b: {<<: *a, d: 2}
        ^
    write the settings out""",
    ),
    "key twice": (
        "a: 1\nb: {c: 1, c: 2}\n",
        """g.yaml:2:11: the key 'c' stands twice
    b: {c: 1, c: 2}
              ^
    it stands first in line 2""",
    ),
    "forbidden tag": (
        "a: !!python/object/apply:os.system [ls]\n",
        """g.yaml:1:4: the tag 'tag:yaml.org,2002:python/object/apply:os.system' is not allowed: plain values only
    a: !!python/object/apply:os.system [ls]
       ^""",  # noqa: E501
    ),
    "tag on a scalar": (
        "a: !!python/name:os.system x\n",
        """g.yaml:1:4: the tag 'tag:yaml.org,2002:python/name:os.system' is not allowed: plain values only
    a: !!python/name:os.system x
       ^""",  # noqa: E501
    ),
    "own tag": (
        "a: !secret x\n",
        """g.yaml:1:4: the tag '!secret' is not allowed: plain values only
    a: !secret x
       ^""",
    ),
    "syntax": (
        "a: [1, 2\nb: 3\n",
        """g.yaml:2:2: not valid YAML: expected ',' or ']', but got ':'
    b: 3
     ^""",
    ),
    "tab": (
        "a:\n\tb: 1\n",
        """g.yaml:2:1: not valid YAML: found character '\\t' that cannot start any token
    \tb: 1
    ^""",
    ),
    "unknown alias": (
        "a: *b\n",
        """g.yaml:1:4: not valid YAML: found undefined alias 'b'
    a: *b
       ^""",
    ),
    "two documents": (
        "a: 1\n---\nb: 2\n",
        "g.yaml:2:1: not valid YAML: expected a single document in the stream, "
        """but found another document
    ---
    ^""",
    ),
    "control character": (
        "a: \x00",
        "g.yaml:1:4: not valid YAML: the character #x0000 cannot stand in YAML",
    ),
    "octal": (
        "a: 1\nb: [010]\n",
        """g.yaml:2:5: '010' is 8 in YAML: write that number, or quotes around it
    b: [010]
        ^""",
    ),
    "sexagesimal": (
        "a: 1:20\n",
        """g.yaml:1:4: '1:20' is 80 in YAML: write that number, or quotes around it
    a: 1:20
       ^""",
    ),
    "a list": ("- 1\n", "g.yaml:1:1: expected a mapping such as 'mushpipe: 1'"),
    "a word": ("mushpipe\n", "g.yaml:1:1: expected a mapping such as 'mushpipe: 1'"),
    "nothing": ("", "g.yaml:1:1: expected a mapping such as 'mushpipe: 1'"),
    "no integer": (
        "a: !!int seven\n",
        """g.yaml:1:4: not a valid int: 'seven'
    a: !!int seven
       ^""",
    ),
}


@pytest.mark.parametrize(("text", "expected"), BROKEN.values(), ids=BROKEN)
def test_what_is_refused_and_how_it_is_said(text, expected):
    assert refused(text) == expected


@pytest.mark.parametrize(
    "text", ["a: !!bool perhaps", "a: !!int ''", "a: !!float ''", 'a: "\\UFFFFFFFF"']
)
def test_values_that_trip_the_yaml_library_are_refused(text):
    assert "not " in refused(text)
    assert refused(text).startswith("g.yaml")


def test_all_faults_of_the_text_are_reported_together():
    lines = refused("a: !x 1\nb: 2\nb: 3\nc: !y 4\n").splitlines()
    places = [line.split(": ")[0] for line in lines if line.startswith("g.yaml")]
    assert places == ["g.yaml:1:4", "g.yaml:3:1", "g.yaml:4:4"]


def test_an_alias_bomb_is_refused_once_and_soon():
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    levels += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    text = refused("\n".join(levels))
    assert text.count("too large after its aliases are expanded") == 1


def test_a_list_that_contains_itself_is_refused():
    assert "nested too deeply" in refused("a: &x [*x]")


def test_anchors_that_stay_small_are_expanded():
    assert parse("a: &x {k: 1}\nb: *x\n").data == {"a": {"k": 1}, "b": {"k": 1}}


@pytest.mark.parametrize(
    ("depth", "message"),
    [(60, "nested too deeply"), (5_000, "not valid YAML: it is nested too deeply")],
)
def test_deep_nesting_is_refused(depth, message):
    assert message in refused("a: " + "[" * depth + "]" * depth)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-2.5", -2.5),
        ("true", True),
        ("~", None),
        ("text", "text"),
        ("'7'", "7"),
        ("2024-05-01", "2024-05-01"),
        ("0x1f", 31),
    ],
)
def test_plain_values(text, value):
    data = parse(f"a: {text}").data["a"]
    assert data == value
    assert type(data) is type(value)


def test_a_missing_file(tmp_path):
    with pytest.raises(GraphError) as caught:
        read_document(tmp_path / "no.yaml")
    assert str(caught.value) == f"{tmp_path}/no.yaml: there is no such file"
    assert caught.value.exit_code == 2


def test_a_file_that_is_no_text(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_bytes(b"b: 1\na: \xff\xfe")
    with pytest.raises(GraphError, match=r"bad\.yaml:2:4: not UTF-8: the byte 0xff"):
        read_document(path)
    with pytest.raises(GraphError, match=r"cannot be read: Is a directory$"):
        read_document(tmp_path)


def test_a_file_is_read_with_its_name_and_folder(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text("a: ö\n", encoding="utf-8")
    document = read_document(path)
    assert (document.data, document.file, document.base) == ({"a": "ö"}, str(path), tmp_path)


def test_a_problem_is_placed_at_the_nearest_place_that_is_in_the_file():
    document = parse("a:\n  b: 1\n")
    assert str(document.problem(("a", "b", "c", 3), "x")) == "g.yaml:2:6: x\n      b: 1\n         ^"
    assert str(document.problem(("a", "b"), "x", key=True)).startswith("g.yaml:2:3: x")
    document.overrides[("a", "b")] = "--set a.b=1"
    assert str(document.problem(("a", "b", "c"), "x", "a hint")) == "--set a.b=1: x\n    a hint"


def test_a_document_that_is_no_text_has_no_places():
    assert str(Document("a capsule", HERE).problem(("a",), "x")) == "a capsule: x"


# 0E0 is a number here, as in YAML 1.2, and a string to PyYAML, which writes it without quotes.
texts = st.text().filter(lambda text: not re.fullmatch(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+", text))
scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | texts
trees = st.recursive(
    scalars, lambda inner: st.lists(inner) | st.dictionaries(texts, inner), max_leaves=8
)


@given(st.dictionaries(texts, trees))
def test_what_json_can_say_survives_yaml(data):
    # JSON strings with escapes are YAML: an independent writer of the same data.
    data = json.loads(json.dumps(data))
    text = yaml.safe_dump(data, allow_unicode=False)
    assert parse(text).data == data


@given(st.text(alphabet=st.sampled_from("ab:-[]{}&*!'\"\\Uxu0 \n,#|>?%@<=~.1e"), max_size=40))
@example("a: !!bool x")
@example("? [a]\n: 1\n? [b]\n: 2")
@example("%YAML 1.1\n---\n")
def test_any_text_is_either_data_or_a_graph_error(text):
    try:
        data = parse(text).data
    except GraphError:
        return
    assert isinstance(data, dict)
    json.dumps(data)
