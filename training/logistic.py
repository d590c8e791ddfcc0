"""Logistic regression over named features, and files of it for `mushpipe.stages.verifier`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from mushpipe.core.arrays import Floats
from mushpipe.stages.verifier import COLUMNS


def fit(
    features: Floats,
    right: Floats,
    names: tuple[str, ...],
    ridge: float,
    limit: float,
    squared: tuple[str, ...],
    share: float | None = None,
) -> dict[str, Any]:
    """Return a model: logistic regression on standardised features (N, F) and the squares of some.

    Standardised features are clipped to ±`limit`. The ridge (per sample) keeps weights small;
    without class weights the probability is calibrated on the scenes of the training, or, given the
    `share` of the right ones, on scenes that have it.
    """
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
    z = np.clip((features - mean) / scale, -limit, limit)
    basis = np.column_stack([np.ones(len(z)), z, z * z * np.isin(names, squared)])

    def loss(w: Floats) -> tuple[float, Floats]:
        odds = basis @ w
        value = np.logaddexp(0, odds).mean() - (right * odds).mean()
        slope = basis.T @ (expit(odds) - right) / len(right)
        slope[1:] += ridge * w[1:]
        return float(value + 0.5 * ridge * (w[1:] ** 2).sum()), slope

    w = minimize(loss, np.zeros(basis.shape[1]), jac=True, method="L-BFGS-B").x
    if share is not None:
        w[0] += logit(share) - logit(right.mean())
    first, second = w[1 : 1 + len(names)], w[1 + len(names) :]
    table = np.column_stack([mean, scale, first, second]).round(4).tolist()
    values = {n: dict(zip(COLUMNS, row, strict=True)) for n, row in zip(names, table, strict=True)}
    return {"intercept": round(float(w[0]), 4), "features": values}


def write(models: dict[str, Any], path: Path, head: str) -> None:
    """Write the file of a verifier."""
    lines = [head + "models:"]
    for name, model in models.items():
        lines += [f"  {name}:", f"    intercept: {model['intercept']}", "    features:"]
        for feature, values in model["features"].items():
            text = ", ".join(f"{column}: {value}" for column, value in values.items())
            lines.append(f"      {feature}: {{{text}}}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
