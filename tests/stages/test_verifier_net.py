"""Models of the verifier: what they compute, and files of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mushpipe.core.errors import UsageError
from mushpipe.stages.phase.verifier import load_verifier
from mushpipe.stages.verifier_net import (
    LIMIT,
    WIDTHS,
    Floats,
    probability,
    read_models,
    shapes,
    write_models,
)

FEATURES = ("one", "two", "three", "four")


def model(features: int, seed: int) -> dict[str, Floats]:
    """Return a model of random weights."""
    rng = np.random.default_rng(seed)
    parts = {part: rng.normal(0, 0.5, shape) for part, shape in shapes(features).items()}
    return parts | {"scale": rng.uniform(0.2, 2, features)}


def expected(rows: Floats, parts: dict[str, Floats]) -> Floats:
    """Return the probabilities of rows by the formula of `Models`."""
    z = np.clip((rows - parts["mean"]) / parts["scale"], -LIMIT, LIMIT)
    hidden = np.maximum(0, np.maximum(0, z @ parts["w1"] + parts["b1"]) @ parts["w2"] + parts["b2"])
    logit = parts["b3"][0] + z @ parts["a"] + z**2 @ parts["s"] + hidden @ parts["w3"]
    return 1 / (1 + np.exp(-logit))


def test_the_probability_is_that_of_the_formula_with_features_by_their_names(
    tmp_path: Path,
) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "models.npz"
    first, second = model(4, 1), model(2, 2)
    write_models(path, {"first": (FEATURES, first), "second": (("four", "one"), second)})
    models = read_models(path, ["second", "first"], FEATURES)
    rows = rng.normal(0, 3, (200, 4))
    room = np.empty(WIDTHS[0], np.float32), np.empty(WIDTHS[1], np.float32)
    for which, wanted in enumerate((expected(rows[:, [3, 0]], second), expected(rows, first))):
        found = [probability(row, models, which, *room) for row in rows]
        assert found == pytest.approx(wanted, abs=2e-5)


def test_parts_that_a_file_leaves_out_are_0(tmp_path: Path) -> None:
    path, rows = tmp_path / "models.npz", np.random.default_rng(0).normal(0, 1, (50, 4))
    whole = model(4, 1)
    logistic = {part: whole[part] for part in ("mean", "scale", "a", "b3")}
    write_models(path, {"m": (FEATURES, logistic)})
    models = read_models(path, ["m"], FEATURES)
    room = np.empty(WIDTHS[0], np.float32), np.empty(WIDTHS[1], np.float32)
    found = [probability(row, models, 0, *room) for row in rows]
    rest = {part: np.zeros(shape) for part, shape in shapes(4).items()}
    assert found == pytest.approx(expected(rows, rest | logistic), abs=2e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"m/features": np.array(["one", "two", "luck"])}, r"unknown features \['luck'\]"),
        ({"m/a": np.zeros(3)}, r"'m/a' must be \(4,\) finite numbers"),
        ({"m/w2": np.full(WIDTHS, np.nan)}, r"'m/w2' must be .* finite numbers"),
        ({"m/mean": None}, "it lacks 'm/mean"),
        ({"m/features": None}, "it lacks 'm/features"),
    ],
)
def test_a_model_that_is_none_is_refused_by_name(
    tmp_path: Path, change: dict[str, np.ndarray | None], message: str
) -> None:
    path = tmp_path / "models.npz"
    write_models(path, {"m": (FEATURES, model(4, 1))})
    with np.load(path) as file:
        arrays = dict(file) | change
    np.savez(path, **{name: part for name, part in arrays.items() if part is not None})
    with pytest.raises(UsageError, match=message):
        read_models(path, ["m"], FEATURES)


@pytest.mark.parametrize("content", [b"", b"models: {}", b"PK\x03\x04", b"\x93NUMPY"])
def test_a_file_that_is_no_verifier_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=r"mine\.npz: .*; expected a file as `make verifier`"):
        load_verifier(path)
    with pytest.raises(UsageError, match=r"none\.npz: No such file"):
        load_verifier(tmp_path / "none.npz")
    np.save(path.with_suffix(".npy"), np.zeros(3))
    with pytest.raises(UsageError, match="expected a file as `make verifier`"):
        load_verifier(path.with_suffix(".npy"))
