"""Models that say how likely a candidate is a cap: logistic, or small networks.

`training/verifier.py` makes those of the package from the simulator alone.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.errors import UsageError
from mushpipe.core.jit import borrower

LIMIT = 2.5  # of a standardised feature: beyond the scenes of the training it says no more
WIDTHS = (32, 16)  # of the two hidden layers
_EXPECTED = "expected a file as `make verifier` writes it"


class Models(NamedTuple):
    """M models over the same F features, each a logistic regression plus a network.

    Of standardised features z, clipped to ±`LIMIT`, the logit is
    b3 + a z + s z² + w3 relu(w2 relu(w1 z + b1) + b2); either part may be 0.

    Attributes:
        mean: (M, F).
        scale: (M, F).
        a: (M, F); 0 for features that a model does not use, as s and w1.
        s: (M, F).
        w1: (M, F, H).
        b1: (M, H).
        w2: (M, H, K).
        b2: (M, K).
        w3: (M, K); all 0 where there is no network.
        b3: (M, 1).
    """

    mean: Singles
    scale: Singles
    a: Singles
    s: Singles
    w1: Singles
    b1: Singles
    w2: Singles
    b2: Singles
    w3: Singles
    b3: Singles


_PER_FEATURE = ("mean", "scale", "a", "s", "w1")


def shapes(features: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the parts of one model."""
    first, second = WIDTHS
    inputs = dict.fromkeys(_PER_FEATURE[:4], (features,))
    hidden = {"w1": (features, first), "b1": (first,), "w2": WIDTHS, "b2": (second,)}
    return {**inputs, **hidden, "w3": (second,), "b3": (1,)}


def write_models(path: Path, models: dict[str, tuple[Sequence[str], dict[str, Floats]]]) -> None:
    """Write models by their names: the features of each, and its parts that are not 0."""
    arrays: dict[str, NDArray[np.generic]] = {}
    for name, (features, parts) in models.items():
        arrays[f"{name}/features"] = np.array(features)
        arrays |= {f"{name}/{part}": value.astype(np.float32) for part, value in parts.items()}
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_models(path: Path, names: Sequence[str], features: Sequence[str]) -> Models:
    """Return models of these names over these features, stacked in this order.

    Raises:
        UsageError: There is no such file, it lacks a model, or a model is not over these features.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = [_spread(file, name, features) for name in names]
    except OSError as error:
        raise UsageError(f"verifier {path}: {error.strerror or error}; {_EXPECTED}") from error
    except KeyError as error:
        raise UsageError(f"verifier {path}: it lacks {error}; {_EXPECTED}") from error
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        text = " ".join(str(error).split())  # in one line
        raise UsageError(f"verifier {path}: {text}; {_EXPECTED}") from error
    return Models(*(np.stack([model[part] for model in found]) for part in Models._fields))


def _spread(file: np.lib.npyio.NpzFile, name: str, features: Sequence[str]) -> dict[str, Singles]:
    """Return the parts of a model, over all features: those it does not know get no weight.

    Raises:
        ValueError: It has a feature that does not exist, or parts of other shapes.
        KeyError: It does not exist, or lacks mean or scale.
    """
    known = [str(feature) for feature in file[f"{name}/features"]]
    if unknown := sorted(set(known) - set(features)):
        raise ValueError(f"unknown features {unknown}")
    parts = {}
    for part, shape in shapes(len(known)).items():
        key = f"{name}/{part}"
        missing = key not in file and part not in ("mean", "scale", "b3")
        value = np.asarray(np.zeros(shape) if missing else file[key], np.float32)
        if value.shape != shape or not np.isfinite(value).all():
            raise ValueError(f"'{key}' must be {shape} finite numbers")
        parts[part] = value
    columns = [features.index(feature) for feature in known]
    for part in _PER_FEATURE:
        rest = 1 if part == "scale" else 0
        whole = np.full((len(features), *parts[part].shape[1:]), rest, np.float32)
        whole[columns] = parts[part]
        parts[part] = whole
    return parts


@borrower
def probability(row: Floats, models: Models, which: int, first: Singles, second: Singles) -> float:
    """Return what a model says of a row of features (F,).

    Args:
        row: Features.
        models: The models.
        which: The number of the one that is asked.
        first: (H,) to work in.
        second: (K,) to work in.
    """
    mean, scale, a, s = models.mean[which], models.scale[which], models.a[which], models.s[which]
    w1, w2, w3 = models.w1[which], models.w2[which], models.w3[which]
    logit = models.b3[which, 0]
    first[:] = second[:] = 0.0
    _add(1.0, models.b1[which], first)
    _add(1.0, models.b2[which], second)
    for f in range(len(row)):
        z = min(LIMIT, max(-LIMIT, (row[f] - mean[f]) / scale[f]))
        logit += a[f] * z + s[f] * z * z
        _add(z, w1[f], first)
    for h in range(len(first)):
        _add(max(0.0, first[h]), w2[h], second)
    for k in range(len(second)):
        logit += w3[k] * max(np.float32(0), second[k])
    return float(1 / (1 + math.exp(-logit)))


@borrower
def _add(factor: float, weights: Singles, total: Singles) -> None:
    single = np.float32(factor)
    for k in range(len(total)):
        total[k] += single * weights[k]
