"""The camera model and rotations.

Lens distortion is the Brown-Conrady polynomial (Brown 1966) with coefficients
``k1 k2 p1 p2 k3``. The model ``brown_conrady`` (ROS: plumb_bob) applies it on the way into the
image; ``inverse_brown_conrady``, which Intel uses for SR300 depth, on the way out of it.
``rational`` (ROS: rational_polynomial) divides the radial part by another polynomial, ``k4 k5 k6``,
as OpenCV does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import Polynomial

from mushpipe.core.arrays import Floats

COEFFICIENTS = {"none": 0, "brown_conrady": 5, "inverse_brown_conrady": 5, "rational": 8}
_FORWARD = ("brown_conrady", "rational")
_ROUNDS = 60  # of Newton's method, at most
_BLOCK = 16_384  # points at a time: whole images would leave the processor's cache


def brown(xy: Floats, coefficients: tuple[float, ...]) -> Floats:
    """Apply the Brown-Conrady polynomial to normalised image coordinates.

    Args:
        xy: (..., 2) coordinates on the plane z = 1.
        coefficients: ``k1 k2 p1 p2 k3``, then ``k4 k5 k6`` of the rational model.

    Returns:
        (..., 2) distorted coordinates.
    """
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    return np.stack(_lens(x, y, r2, _radial(r2, coefficients)[0], coefficients), axis=-1)


def _radial(r2: Floats, coefficients: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return the radial factor at r^2, and its derivative by r^2."""
    k1, k2, _, _, k3, *below = coefficients
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * (3 * k3))
    if below:
        k4, k5, k6 = below
        under = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = radial / under
        slope = (slope - radial * (k4 + r2 * (2 * k5 + r2 * (3 * k6)))) / under
    return radial, slope


def _lens(
    x: Floats, y: Floats, r2: Floats, radial: Floats, coefficients: tuple[float, ...]
) -> tuple[Floats, Floats]:
    p1, p2 = coefficients[2:4]
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    )


def brown_inverse(xy: Floats, coefficients: tuple[float, ...]) -> Floats:
    """Undo `brown` by Newton's method.

    Points where no pre-image is found to 1e-7 become NaN, and so do pre-images beyond the fold of
    the polynomial: a lens model is only valid inside the image it was fitted on, and a wrong ray
    must not pass for a right one.
    """
    wanted = xy.reshape(-1, 2).astype(np.float64)
    found = np.empty_like(wanted)
    for start in range(0, len(wanted), _BLOCK):
        part = slice(start, start + _BLOCK)
        found[part] = _block_inverse(wanted[part], coefficients)
    return found.reshape(xy.shape)


def _block_inverse(wanted: Floats, coefficients: tuple[float, ...]) -> Floats:
    """Undo `brown` for points (N, 2)."""
    wanted_x, wanted_y = np.ascontiguousarray(wanted.T)
    x, y = wanted_x.copy(), wanted_y.copy()
    with np.errstate(all="ignore"):
        # A wide lens ends inside the image, and of what lies beyond nothing would converge.
        left = np.flatnonzero(~(np.hypot(wanted_x, wanted_y) > _farthest_image(coefficients)))
        for _ in range(_ROUNDS):
            u, v = x[left], y[left]
            r2 = u * u + v * v
            radial, slope = _radial(r2, coefficients)
            image_x, image_y = _lens(u, v, r2, radial, coefficients)
            off = image_x - wanted_x[left], image_y - wanted_y[left]
            going = np.maximum(np.abs(off[0]), np.abs(off[1])) >= 1e-12
            if not going.any():
                break
            dx, dy = _newton(u, v, radial, slope, off, coefficients)
            left = left[going]
            x[left] -= dx[going]
            y[left] -= dy[going]
        guess = np.column_stack([x, y])
        bad = ~(np.abs(brown(guess, coefficients) - wanted).max(axis=-1) < 1e-7)
        bad |= (guess**2).sum(axis=-1) >= _fold(coefficients)
    guess[bad] = np.nan
    return guess


def _newton(
    x: Floats,
    y: Floats,
    radial: Floats,
    slope: Floats,
    off: tuple[Floats, Floats],
    coefficients: tuple[float, ...],
) -> tuple[Floats, Floats]:
    """Return what to take off x and y, whose images are off by so much."""
    p1, p2 = coefficients[2:4]
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + 2 * y * y * slope + 2 * p2 * x + 6 * p1 * y
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y  # of x by y, and of y by x
    det = xx * yy - xy * xy
    return (yy * off[0] - xy * off[1]) / det, (xx * off[1] - xy * off[0]) / det


@cache
def _farthest_image(coefficients: tuple[float, ...]) -> float:
    """Return how far from the centre the image of a point short of the fold can lie."""
    fold = _fold(coefficients)
    if not np.isfinite(fold):
        return np.inf
    reach = np.linspace(0, np.sqrt(fold), 100)
    image = reach * _radial(reach**2, coefficients)[0]
    tangential = 3 * (abs(coefficients[2]) + abs(coefficients[3])) * fold
    return float(1.01 * np.abs(image).max() + tangential)


@cache
def _fold(coefficients: tuple[float, ...]) -> float:
    """Return the least r^2 at which the radial part of `brown` no longer grows; inf without one."""
    k1, k2, _, _, k3, *below = coefficients
    over, under = Polynomial((1, k1, k2, k3)), Polynomial((1, *below))
    s = Polynomial((0, 1))
    # d/dr of r over(r^2) / under(r^2), times under^2
    slope = over * under + 2 * s * (over.deriv() * under - over * under.deriv())
    roots = np.concatenate([slope.trim().roots(), under.trim().roots()])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def _short_of_fold(xy: Floats, coefficients: tuple[float, ...]) -> Floats:
    """Return coordinates (..., 2); NaN from the fold on, where `brown` gives those of others."""
    beyond = (xy**2).sum(axis=-1) >= _fold(coefficients)
    return np.where(beyond[..., None], np.nan, xy)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with lens distortion; lengths in px.

    Attributes:
        width: Image width.
        height: Image height.
        fx: Focal length along x.
        fy: Focal length along y.
        cx: Principal point, x; the centre of the first pixel is 0.
        cy: Principal point, y.
        model: ``none``, ``brown_conrady``, ``inverse_brown_conrady`` or ``rational``.
        coefficients: ``k1 k2 p1 p2 k3``, for ``rational`` with ``k4 k5 k6``; empty for ``none``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "none"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not (self.width > 0 and self.height > 0 and self.fx > 0 and self.fy > 0):
            raise ValueError(f"size and focal length of a camera must be positive: {self}")
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        if not np.isfinite(numbers).all():
            raise ValueError(f"the numbers of a camera must be finite: {self}")
        if len(self.coefficients) != COEFFICIENTS.get(self.model):
            raise ValueError(
                f"camera model '{self.model}' with {len(self.coefficients)} coefficients; "
                "expected none, (inverse_)brown_conrady with k1 k2 p1 p2 k3, or rational with "
                "k4 k5 k6 after these"
            )

    @property
    def focal(self) -> float:
        """The mean focal length."""
        return (self.fx + self.fy) / 2

    @property
    def centred(self) -> bool:
        """Whether the principal point lies within the image."""
        return 0 <= self.cx < self.width and 0 <= self.cy < self.height

    def project(self, points: Floats) -> Floats:
        """Project (..., 3) points in metres to (..., 2) pixels.

        NaN behind the camera, and beyond the angle up to which the lens model holds.
        """
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        xy = points[..., :2] / z[..., None]
        if self.model in _FORWARD:
            xy = brown(_short_of_fold(xy, self.coefficients), self.coefficients)
        elif self.model == "inverse_brown_conrady":
            xy = brown_inverse(xy, self.coefficients)
        return np.asarray(xy * (self.fx, self.fy) + (self.cx, self.cy))

    def deproject(self, pixels: Floats, depth: Floats) -> Floats:
        """Lift (..., 2) pixels at (...,) depths (z in metres) to (..., 3) points.

        NaN where the lens model does not hold.
        """
        xy = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.model in _FORWARD:
            xy = brown_inverse(xy, self.coefficients)
        elif self.model == "inverse_brown_conrady":
            xy = brown(_short_of_fold(xy, self.coefficients), self.coefficients)
        z = np.asarray(depth, dtype=np.float64)[..., None]
        return np.concatenate([xy * z, z], axis=-1)


def quaternion_from_axis(axis: Floats) -> Floats:
    """Return the shortest rotations that take +z to the given unit axes.

    Args:
        axis: (N, 3) unit vectors; rows of NaN stay NaN.

    Returns:
        (N, 4) quaternions x y z w with w >= 0 and no spin about z. An axis of exactly -z has no
        shortest rotation; half a turn about x is returned for it.
    """
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    # q = (z_hat x axis, 1 + z_hat . axis), normalised; next to -z what its length lacks would count
    w = np.where(z < -1 + 1e-6, lengths(axis), 1.0) + z
    q = np.zeros((len(axis), 4))
    q[:, 0], q[:, 1], q[:, 3] = -y, x, w
    q[w < 1e-12] = [1.0, 0.0, 0.0, 0.0]
    return q / lengths(q)[:, None]


def axis_from_quaternion(quaternion: Floats) -> Floats:
    """Return where unit quaternions (N, 4), x y z w, turn +z to: (N, 3); rows of NaN stay NaN."""
    x, y, z, w = quaternion.T
    return np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def lengths(vectors: Floats) -> Floats:
    """Return the lengths (N,) of vectors (N, k), in half the time of `np.linalg.norm`."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))
