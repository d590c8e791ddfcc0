"""Verifiers: logistic models over named features, read from files.

`training/verifier.py` and `training/fitted.py` make those of the package from the simulator alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mushpipe.core.arrays import Floats
from mushpipe.core.errors import UsageError

COLUMNS = ("mean", "scale", "weight", "square")
LIMIT = 4.0  # of a standardised feature: beyond the scenes of the training it says no more
_EXPECTED = "expected a file as `make verifier` writes it"


def package_file(name: str) -> Path:
    """Return a file of weights that comes with the package."""
    return Path(__file__).with_name(name)


def read_models(path: Path, names: Sequence[str], features: Sequence[str]) -> dict[str, Floats]:
    """Return the weights (F + 1, 4) of models, as `weights_of`, by their names.

    Raises:
        UsageError: There is no such file, it lacks a model, or a model is not over these features.
    """
    try:
        models = yaml.safe_load(path.read_text(encoding="utf-8"))["models"]
        return {name: weights_of(models[name], features) for name in names}
    except OSError as error:
        raise UsageError(f"verifier {path}: {error.strerror}") from error
    except KeyError as error:
        raise UsageError(f"verifier {path}: it lacks {error}; {_EXPECTED}") from error
    except (yaml.YAMLError, TypeError, ValueError) as error:
        text = " ".join(str(error).split())  # in one line
        raise UsageError(f"verifier {path}: {text}; {_EXPECTED}") from error


def weights_of(model: dict[str, Any], features: Sequence[str]) -> Floats:
    """Return the weights (F + 1, 4) of a model as it stands in the file.

    Row k holds mean, scale, weight and weight of the square of feature k, the last row the
    intercept as its weight. A feature that the model does not name has no weight in it.

    Raises:
        ValueError: It names a feature that does not exist.
        KeyError: It lacks a number.
    """
    unknown = set(model["features"]) - set(features)
    if unknown:
        raise ValueError(f"unknown features {sorted(unknown)}")
    weights = np.zeros((len(features) + 1, len(COLUMNS)))
    weights[:, 1] = 1
    for name, values in model["features"].items():
        weights[features.index(name)] = [values[column] for column in COLUMNS]
    weights[-1, 2] = model["intercept"]
    return weights


def logit(table: Floats, weights: Floats) -> Floats:
    """Return the logits (N,) of rows of features (N, F)."""
    mean, scale, weight, square = weights[:-1].T
    z = np.clip((table - mean) / scale, -LIMIT, LIMIT)
    return np.asarray(weights[-1, 2] + z @ weight + (z * z) @ square)


def logistic(logits: Floats) -> Floats:
    """Return the probabilities (N,) of logits (N,)."""
    return np.asarray(1 / (1 + np.exp(-logits)))
