"""Crops of the frames under everything a camera and a bed may do, and what the net should say."""

from __future__ import annotations

import cv2
import numpy as np

from mushpipe.core.arrays import Bools, Floats, Singles
from mushpipe.core.truth import Ignore
from mushpipe.stages.cap_decode import CHANNELS, HEAT, MASK, OFFSET, RADIUS, STRIDE
from training.net.scenes import Picture
from training.net.texture import NOISE, textured

SMALLEST = 5.0  # px; smaller outlines are not asked for
HIDDEN = 0.3  # nor are those of which less is seen
_BLUR = np.log([0.3, 3.0])  # px


def crop(
    picture: Picture,
    size: int,
    rng: np.random.Generator,
    near: float = 0.0,
    stained: bool = False,
    surfaces: bool = False,
    plain: float = 0.0,
) -> tuple[Singles, Singles, Singles]:
    """Return an image (3, size, size) in 0..1, its target (5, h, w) and weight (h, w).

    Args:
        picture: A frame.
        size: px, a multiple of 32.
        rng: Draws everything.
        near: Share of the crops that are taken around a cap; the others lie anywhere.
        stained: Whether caps and bed may be blotched, overexposed, and set one against the other.
        surfaces: Whether they may have other surfaces, shade each other, and be blurred more.
        plain: Share of the crops that stay much as they are.
    """
    matrix, scale = _placement(picture, size, rng, near)
    color = cv2.warpAffine(
        picture.color, matrix, (size, size), flags=cv2.INTER_LINEAR,
        borderValue=rng.integers(0, 256, 3).tolist(),
    )  # fmt: skip
    warped = cv2.warpAffine(picture.cap.astype(np.float32), matrix, (size, size))
    image, cap = np.asarray(color, np.float32) / np.float32(255), np.asarray(warped, np.float32)
    center = picture.circles[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    circles = np.column_stack([center, picture.circles[:, 2] * scale])
    if surfaces:
        image = textured(image, cap, circles, rng)
    if plain and rng.random() < plain:
        image = snapshot(image, rng)
    else:
        image = photographed(image, cap, rng, stained, surfaces)
    stump = picture.kind == Ignore.CUT_STUMP
    target, weight = aims(circles[~stump], (picture.visible < HIDDEN)[~stump], size // STRIDE)
    target[MASK] = cv2.resize(cap, None, fx=1 / STRIDE, fy=1 / STRIDE, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image.transpose(2, 0, 1)), target, weight


def _placement(
    picture: Picture, size: int, rng: np.random.Generator, near: float
) -> tuple[Floats, float]:
    """Draw an affine map (2, 3) of the frame onto the crop, and its scale."""
    scale = float(np.exp(rng.uniform(np.log(0.5), np.log(2.2))))
    turn = rng.uniform(-np.pi, np.pi)
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[c, -s], [s, c]]) * rng.choice([-1, 1], (1, 1))
    linear[0] *= rng.choice([-1.0, 1.0])
    height, width = picture.cap.shape
    reach = min(0.45 * size / scale, 0.4 * height)
    low, high = np.array((reach, reach)), np.array((width - reach, height - reach))
    middle = rng.uniform(low, high)
    if len(picture.circles) and rng.random() < near:
        cap = picture.circles[rng.integers(len(picture.circles)), :2]
        middle = np.clip(cap + rng.normal(0, 0.2 * size / scale, 2), low, high)
    return np.column_stack([linear, size / 2 - linear @ middle]), scale


def aims(circles: Floats, unsure: Bools, cells: int) -> tuple[Singles, Singles]:
    """Return target (5, h, w), its mask still empty, and weight (h, w) of circles (N, 3) px.

    Heat is a Gaussian of a sixth of the diameter, cut at 1 in the cell of the centre.
    """
    target = np.zeros((CHANNELS, cells, cells), np.float32)
    weight = np.ones((cells, cells), np.float32)
    v, u = np.mgrid[:cells, :cells].astype(np.float32)
    # pixel x lies in cell (x + 0.5) / STRIDE - 0.5
    for (x, y, radius), doubt in zip(circles, unsure, strict=True):
        cx, cy = (x + 0.5) / STRIDE - 0.5, (y + 0.5) / STRIDE - 0.5
        r = radius / STRIDE
        if not (-r < cx < cells + r and -r < cy < cells + r):
            continue
        dx, dy = cx - u, cy - v
        square = dx * dx + dy * dy
        column, row = round(cx), round(cy)
        if doubt or radius < SMALLEST or not (0 <= column < cells and 0 <= row < cells):
            weight[(square < (0.8 * r + 0.7) ** 2) & (target[HEAT] < 0.3)] = 0
            continue
        heat = np.exp(-square / (2 * max(r / 3, 0.7) ** 2))
        heat[row, column] = 1
        nearer = heat > target[HEAT]
        target[HEAT][nearer] = heat[nearer]
        target[RADIUS][nearer] = np.log(r)
        target[OFFSET.start][nearer], target[OFFSET.start + 1][nearer] = dx[nearer], dy[nearer]
        weight[heat > 0.3] = 1
    return target, weight


def snapshot(image: Singles, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) a little brighter or darker, less sharp and noisier."""
    image = image * np.exp(rng.normal(0, 0.25) + rng.normal(0, 0.05, 3)).astype(np.float32)
    image = np.clip(image, 0, 1) ** np.float32(np.exp(rng.normal(0, 0.12)))
    if rng.random() < 0.3:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.3, 1.2))))
    noise = rng.standard_normal(image.shape, np.float32) * np.float32(rng.exponential(0.008))
    return np.asarray(np.clip(image + noise, 0, 1), np.float32)


def photographed(
    image: Singles, cap: Singles, rng: np.random.Generator, stained: bool, blurred: bool
) -> Singles:
    """Return an image (H, W, 3) with other colours, light, blur, noise and things before it."""
    if rng.random() < 0.4:  # other caps on the same bed
        gain = np.exp(rng.uniform(-0.8, 0.3) + rng.normal(0, 0.12, 3)).astype(np.float32)
        image = image * (1 + cap[..., None] * (gain - 1))
    if stained:
        image = _stained(image, cap, rng)
    if rng.random() < 0.3:  # gaps between caps are black in contrasty pictures
        image = blackened(image, cap, rng)
    image = cv2.transform(image, _toned(rng))
    image = cv2.pow(np.clip(image, 0, 1), float(np.exp(rng.normal(0, 0.25))))
    image *= (_light(image.shape[0], rng) * np.float32(np.exp(rng.normal(0, 0.3))))[..., None]
    image += np.float32(rng.normal(0, 0.03))
    darkest = rng.uniform(0.04, 0.2)  # mean of the image
    image *= np.float32(max(1.0, darkest / max(sum(cv2.mean(image)) / 3, 1e-3)))
    if stained and rng.random() < 0.2:
        image = overexposed(image, cap, rng)
    image = _patches(image, rng)
    if rng.random() < 0.4:
        sigma = np.exp(rng.uniform(*_BLUR)) if blurred else rng.uniform(0.3, 1.5)
        image = cv2.GaussianBlur(image, (0, 0), float(sigma))
    start = rng.integers(len(NOISE) - image.size)
    noise = NOISE[start : start + image.size].reshape(image.shape)
    image += noise * np.float32(rng.exponential(0.015))
    return np.asarray(np.clip(image, 0, 1), np.float32)


def _toned(rng: np.random.Generator) -> Floats:
    """Draw a matrix (3, 3) of colours: white balance, then saturation."""
    saturation = rng.uniform(0.2, 1.6)
    around_gray = saturation * np.eye(3) + (1 - saturation) / 3
    return np.asarray(around_gray * np.exp(rng.normal(0, 0.08, 3)))


def _stained(image: Singles, cap: Singles, rng: np.random.Generator) -> Singles:
    """Give caps another bed, and both of them blotches."""
    if rng.random() < 0.3:
        gain = np.exp(rng.uniform(-0.3, 1.2) + rng.normal(0, 0.1, 3)).astype(np.float32)
        image = image * (1 + (1 - cap)[..., None] * (gain - 1))
    if rng.random() < 0.35:  # scales, stains and bruises
        image = blotched(image, cap, rng)
    if rng.random() < 0.2:  # so blotches alone make no cap
        image = blotched(image, 1 - cap, rng)
    return image


def blotched(image: Singles, where: Singles, rng: np.random.Generator) -> Singles:
    """Blotch what lies in `where` (H, W) 0..1, more in some places than in others."""
    height, width = where.shape
    size = max(height, width)

    def smooth(cells: int) -> Singles:
        field = rng.standard_normal((cells, cells), np.float32)
        square = cv2.resize(field, (size, size), interpolation=cv2.INTER_CUBIC)
        return np.asarray(square[:height, :width])

    fine = smooth(int(size / rng.uniform(3, 16)))
    amount = 1 / (1 + np.exp(-np.float32(rng.uniform(2, 6)) * fine - 3 * smooth(5)))
    gain = np.exp(rng.uniform(-0.9, 0.3) + rng.normal(0, 0.15, 3)).astype(np.float32)
    return np.asarray(image * (1 + (where * amount)[..., None] * (gain - 1)), np.float32)


def overexposed(image: Singles, cap: Singles, rng: np.random.Generator) -> Singles:
    """Brighten the image until a part of the caps, or most of them, is white."""
    inside = image[cap > 0.9]
    usual = float(np.median(inside)) if len(inside) else 0.5
    return image * np.float32(max(1.0, rng.uniform(0.7, 2) / max(usual, 0.05)))


def blackened(image: Singles, cap: Singles, rng: np.random.Generator) -> Singles:
    """Raise the black point towards the darkest parts of the caps."""
    inside = image[cap > 0.9]
    darkest = float(np.quantile(inside.mean(axis=1), 0.05)) if len(inside) else 0.2
    black = np.float32(min(0.9, rng.uniform(0.2, 1) * darkest))
    return np.asarray(np.maximum(image - black, 0) / (1 - black), np.float32)


def _light(size: int, rng: np.random.Generator) -> Singles:
    """Return smooth light and, at times, the edge of a shadow."""
    field = rng.normal(0, rng.uniform(0, 0.45), (4, 4)).astype(np.float32)
    light = np.exp(cv2.resize(field, (size, size), interpolation=cv2.INTER_CUBIC))
    if rng.random() < 0.2:
        turn, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4)
        v, u = np.mgrid[-0.5 : 0.5 : size * 1j, -0.5 : 0.5 : size * 1j]
        dark = np.clip((u * np.cos(turn) + v * np.sin(turn) - offset) * size / 6, 0, 1)
        light = light * (1 - rng.uniform(0.2, 0.7) * dark).astype(np.float32)
    return np.asarray(light, np.float32)


def _patches(image: Singles, rng: np.random.Generator) -> Singles:
    """Lay some flat or striped bars over the image."""
    size = image.shape[0]
    for _ in range(rng.poisson(0.5)):
        corner = rng.uniform(0, size, 2)
        box = (tuple(corner), tuple(rng.uniform(3, 40, 2)), float(rng.uniform(0, 180)))
        points = np.rint(cv2.boxPoints(box)).astype(np.int32)
        image = np.ascontiguousarray(image)
        cv2.fillConvexPoly(image, points, rng.uniform(0, 1, 3).tolist(), cv2.LINE_AA)
    return image
