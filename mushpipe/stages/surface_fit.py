"""Position and diameter of each cap from the surface around its centre; no model of the cap."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from mushpipe import Camera, Circles, DepthSource, Locations, RgbdFrame, Stage
from mushpipe.core.arrays import Bytes, Floats, Ints, Rows, Singles
from mushpipe.core.geometry import lengths
from mushpipe.core.jit import borrower
from mushpipe.stages.calibrated import calibration_of
from mushpipe.stages.cap.blocks import CELLS, Image
from mushpipe.stages.cap.model import ASPECT, ASPECT_SIGMA, LIP
from mushpipe.stages.cap.order import Order, by_depth
from mushpipe.stages.cap.samples import ASTRAY
from mushpipe.stages.discs import discs_of, radii_on_rays
from mushpipe.stages.paraboloid import COEFFICIENTS, SHAPE_M, TIP, fit_surfaces
from mushpipe.stages.upright import pixel_rays
from mushpipe.stages.warm_up import example_circles, example_frame

OUTLINE = 0.008  # sigma of a cap's diameter about that of its outline, relative
WHOLE = 0.85  # share of the grid that finds depth on a cap which nothing hides
STEEPEST = np.radians(60)
SLOPE = np.radians(12)  # sigma of the tilt that a slope shows: caps are neither even nor round
SPREAD = np.radians(15)  # of the tilts in a bed about what they have in common, per direction


class SurfaceFit(Stage):
    """Fits a paraboloid with a tip to the depth around each circle's centre.

    The position is that surface's at the centre, also where depth is missing just there. The
    diameter is the circle's at the depth of the rim, put right for the tilt that the surface's
    slope shows. Nearer mushrooms' circles hide what they cover. A mushroom with hardly any depth
    is ``missing``.
    """

    depth_noise_mm: float = Field(0.3, ge=0, description="sigma of depth at the camera, mm")
    depth_noise_per_m: float = Field(1.2, ge=0, description="its growth with depth, mm per m")
    circle_sigma_px: float = Field(
        0.5, gt=0, le=1000, description="sigma of the circles' centres and radii, px"
    )
    min_points: int = Field(8, ge=6, le=30, description="fewest points of the grid a fit needs")

    def open(self) -> None:
        """Compile the kernels."""
        self.process(example_frame(), example_circles())

    def process(self, frame: RgbdFrame, circles: Circles) -> Locations:
        """Return one location per circle.

        Raises:
            InputError: The frame has depth but no calibration.
        """
        if frame.depth is None or not len(circles):
            return Locations.unknown(len(circles))
        camera, depth = calibration_of(frame), frame.depth_m
        discs = discs_of(circles)
        noise = (self.depth_noise_mm / 1000, self.depth_noise_per_m / 1000)
        surface, covariance, seen = fit_tops(depth, camera, discs, noise, self.min_points)
        pixel = self.circle_sigma_px * surface[:, 0] / camera.focal  # its sigma on the cap, m
        size = radii_on_rays(circles, camera) * surface[:, 0]
        smooth = without_tip(surface, covariance)
        ray = camera.deproject(circles.center, np.ones(len(circles)))
        position = ray * surface[:, :1]
        own, other = seen.T
        along = variance_along(smooth[0], covariance, size, pixel)
        along += np.where(other > ASTRAY * (own + other), size**2, 0)
        diameter, sigma_diameter = diameters(*smooth, size, ray)
        # what is hidden of an outline was guessed by the detector
        whole = np.minimum(own / (WHOLE * len(CELLS)), 1) ** 2
        sigma_diameter = np.hypot(sigma_diameter, 2 * pixel) / np.maximum(whole, 1e-3)
        known = np.isfinite(position).all(axis=1)
        # a depth that is off moves the point along its ray, off the optical axis sideways as well
        sideways = np.sqrt(pixel[:, None] ** 2 + ray[:, :2] ** 2 * along[:, None])
        return Locations(
            position=position,
            distance=lengths(position),
            diameter=diameter,
            source=np.where(known, sources(circles, depth), DepthSource.MISSING),
            sigma_position=np.column_stack([sideways, np.sqrt(along)]),
            sigma_diameter=sigma_diameter,
        )


def fit_tops(
    depth: Singles,
    camera: Camera,
    discs: Floats,
    noise: tuple[float, float],
    least: int,
    rows: Rows | None = None,
    order: Order | None = None,
) -> tuple[Floats, Floats, Ints]:
    """Return coefficients (M, 7), m, covariances (M, 7, 7) and numbers of points (M, 2).

    A circle without a fit has NaN.

    Args:
        depth: (H, W) m, missing where not above 0.
        camera: Intrinsics.
        discs: (N, 3) x, y, radius, px.
        noise: Sigma of depth at the camera, m, and its growth, m per m.
        least: Fewest points.
        rows: (M,) which are fitted, all unless given; the others only hide what they cover.
        order: From `by_depth`, if that is known.
    """
    rank, ranks = order or by_depth(depth, discs)
    image = Image(depth, pixel_rays(camera), ranks, camera.focal)
    chosen = np.arange(len(discs)) if rows is None else rows
    n = len(chosen)
    surface = np.full((n, COEFFICIENTS), np.nan)
    covariance = np.full((n, COEFFICIENTS, COEFFICIENTS), np.nan)
    seen = fit_surfaces(image, discs, rank, chosen, noise, least, (surface, covariance))
    return surface, covariance, seen


def without_tip(surface: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return surfaces (N, 7) and covariances (N, 7, 7) under the condition that none is pointed.

    In noisy depth a tip looks much like a bend; slope and bend scatter less without one.
    """
    gain = covariance[:, :, TIP] / covariance[:, TIP, TIP, None]
    shared = gain[:, :, None] * covariance[:, None, TIP]
    return surface - gain * surface[:, TIP, None], covariance - shared


def variance_along(surface: Floats, covariance: Floats, size: Floats, pixel: Floats) -> Floats:
    """Return the variances (N,) m^2 of the depths at the centres of circles.

    Args:
        surface: (N, 7) coefficients, m.
        covariance: (N, 7, 7) of those with a tip.
        size: (N,) radius of the circle at the depth of its centre, m.
        pixel: (N,) sigma of the centre there, m.
    """
    slope = surface[:, 1:3] / size[:, None]
    return np.asarray(covariance[:, 0, 0] + SHAPE_M**2 + (slope**2).sum(axis=1) * pixel**2)


def sources(circles: Circles, depth: Singles) -> Bytes:
    """Return where the depth at the centres (N,) comes from: from there, or from around it."""
    found = np.full(len(circles), DepthSource.NEIGHBOURS, np.uint8)
    _mark_measured(circles.center, depth, int(DepthSource.MEASURED), found)
    return found


@borrower
def _mark_measured(center: Floats, depth: Singles, mark: int, found: Bytes) -> None:
    """Write a mark (N,) for each centre (N, 2), px, at which there is depth (H, W)."""
    for i in range(len(center)):
        u, v = np.rint(center[i, 0]), np.rint(center[i, 1])
        if 0 <= u < depth.shape[1] and 0 <= v < depth.shape[0] and depth[int(v), int(u)] > 0:
            found[i] = mark


def diameters(
    surface: Floats, covariance: Floats, size: Floats, ray: Floats
) -> tuple[Floats, Floats]:
    """Return the diameters (N,) m of caps, and their sigmas but for that of the circle.

    A cap of rim radius R and aspect a, seen at an angle t to its axis, has an outline of the
    half axes R and R (sqrt(c^2 + a^2 s^2) + sqrt(c^2 + l^2 s^2)) / 2 with c = cos t, s = sin t and
    l that of its underside; off the optical axis by f a pinhole stretches areas by 1 / cos f. The
    rim is a R deeper than the top, along the axis. Around the top a spheroid's depth grows by
    a R (x^2 + y^2) / 2, x and y in radii, and its slope is (1 - a^2) of the tilt.

    Args:
        surface: (N, 7) coefficients without a tip, m.
        covariance: (N, 7, 7).
        size: (N,) radius of the circle at the depth of its centre, m.
        ray: (N, 3) ray of the centre at z = 1.
    """
    bend = surface[:, 3] + surface[:, 5]
    spread = covariance[:, 3, 3] + covariance[:, 5, 5] + 2 * covariance[:, 3, 5]
    prior = (ASPECT_SIGMA * size) ** 2
    aspect = (bend * prior + ASPECT * size * spread) / (spread + prior) / size
    aspect = np.clip(aspect, 0.25, 1)
    length = np.linalg.norm(ray, axis=1)
    view = -ray / length[:, None]
    slope = surface[:, 1:3] / size[:, None]
    normal = np.insert(slope, 2, -1.0, axis=1)
    steeper = 1 / np.maximum(1 - aspect**2, 0.35)
    seen = steeper[:, None] * _lean(normal, view)
    noise = steeper * np.sqrt((covariance[:, 1, 1] + covariance[:, 2, 2]) / 2) / size
    fitted = np.isfinite(noise)
    # what the caps of a bed have in common
    upright = np.median((view + seen)[fitted], axis=0) if fitted.any() else np.full(3, np.nan)
    known, common = noise**2 + SLOPE**2, _lean(np.tile(upright, (len(view), 1)), view)
    share = (SPREAD**2 / (SPREAD**2 + known))[:, None]
    variance = share[:, 0] * known
    tilt = np.sqrt(((share * seen + (1 - share) * common) ** 2).sum(axis=1) + variance)
    tilt = np.minimum(tilt, STEEPEST)
    sigma = np.sqrt(variance)

    depth = 1 + aspect * size * np.cos(tilt) / surface[:, 0]
    narrowed = _narrowed(tilt, aspect)
    diameter = 2 * size * depth / narrowed / np.sqrt(length)
    leaning = _narrowed(tilt + sigma, aspect) / narrowed - 1
    return diameter, diameter * np.hypot(OUTLINE, leaning)


def _lean(vectors: Floats, view: Floats) -> Floats:
    """Return how vectors lean off unit vectors: perpendicular to these, as long as the angle."""
    along = (vectors * view).sum(axis=1, keepdims=True)
    across = vectors - along * view
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(across * np.arctan2(length, along) / np.maximum(length, 1e-9))


def _narrowed(tilt: Floats, aspect: Floats) -> Floats:
    """Return the radius of the circle of a tilted cap's area over that of its rim."""
    c2, s2 = np.cos(tilt) ** 2, np.sin(tilt) ** 2
    short = (np.sqrt(c2 + aspect**2 * s2) + np.sqrt(c2 + LIP**2 * s2)) / 2
    return np.asarray(np.sqrt(short))
