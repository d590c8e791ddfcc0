"""What cameras make of an exact view: a photograph, and depth by coded light or by stereo.

Coded light has the axial noise of an SR300, after Table I of Baisa & Al-Diri 2022; stereo matches
windows, so that edges in front grow, and its noise is that of the disparity, shared by neighbours.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Floats, Singles
from mushpipe.sim.photo import srgb
from training.traced.render import View

OFFSET = 0.00285  # m that both read too far, as graphs/pick.yaml has it corrected
UNIT = 0.0001  # m
CODED_BASELINE, STEREO_BASELINE = 0.047, 0.018  # m
FARTHEST = 2.0  # m


def photograph(light: Singles, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return an sRGB picture (H, W, 3) of linear light, exposed for its brighter parts."""
    gray = light.mean(axis=2)
    exposure = rng.uniform(0.55, 1.0) / np.quantile(gray, rng.uniform(0.90, 0.985))
    balance = 1 / light.reshape(-1, 3).mean(axis=0)
    gains = (balance / balance[1]) ** rng.uniform(0, 1)
    image = cv2.GaussianBlur(light * (exposure * gains).astype(np.float32), (0, 0), 0.6)
    image += np.sqrt(3e-5 + 2e-4 * np.maximum(image, 0)) * rng.standard_normal(image.shape)
    return np.asarray(np.rint(255 * srgb(image)), np.uint8)


def coded_light(view: View, fx: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return depth in units of 0.1 mm, 0 where too little light comes back or in shadow."""
    z = np.minimum(view.depth, FARTHEST)
    lost = (view.slant < 0.3) | (z == FARTHEST) | _hidden(z, fx * CODED_BASELINE)
    lost |= _torn(z) & (rng.random(z.shape) < 0.4)
    lost |= rng.random(z.shape) < 0.006
    sigma = 0.0003 + 0.0012 * z
    return _stored(z + sigma * rng.standard_normal(z.shape), lost)


def stereo(view: View, fx: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return depth in units of 0.1 mm, 0 where one camera sees nothing, or both little."""
    power = fx * STEREO_BASELINE
    disparity = (power / view.depth).astype(np.float32)
    grown = cv2.medianBlur(cv2.dilate(disparity, np.ones((3, 3), np.uint8)), 5)
    noise = cv2.GaussianBlur(rng.standard_normal(grown.shape), (0, 0), 2.0)
    grown += 0.06 * noise / noise.std()
    lost = ~np.isfinite(view.depth) | _hidden(view.depth[:, ::-1], power)[:, ::-1]
    patch = cv2.GaussianBlur(rng.standard_normal(grown.shape), (0, 0), 6.0)
    lost |= patch > np.quantile(patch, 0.985)
    return _stored(power / np.maximum(np.rint(32 * grown) / 32, 1), lost)


def _hidden(z: Floats, power: float) -> Bools:
    """Return what a second device, beside the first towards -x, does not reach past what is near.

    Its column is u + power / z; where a point further left has a larger one, that is in the way.
    """
    column = np.arange(z.shape[1]) + power / z
    return np.asarray(np.maximum.accumulate(column, axis=1) > column + 0.5)


def _torn(z: Floats) -> Bools:
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(z, kernel) - cv2.erode(z, kernel) > 0.008)


def _stored(z: Floats, lost: Bools) -> NDArray[np.uint16]:
    known = np.where(lost, 0, z + OFFSET)
    return np.asarray(np.rint(known / UNIT), np.uint16)
