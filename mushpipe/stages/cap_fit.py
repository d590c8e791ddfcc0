"""Position, size and orientation of each cap at once, by fitting a spheroid to its depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field, PrivateAttr

from mushpipe import (
    Camera,
    Circles,
    DepthSource,
    Locations,
    Poses,
    RgbdFrame,
    Stage,
    quaternion_from_axis,
)
from mushpipe.core.arrays import Bytes, Floats, Rows, Singles
from mushpipe.core.geometry import lengths
from mushpipe.stages.calibrated import calibration_of
from mushpipe.stages.cap.attempt import Frame, Settings
from mushpipe.stages.cap.batch import LEVER, Fits, fit_caps
from mushpipe.stages.cap.blocks import Image, Sensor
from mushpipe.stages.cap.clod import CLOD_CHANCE, clods
from mushpipe.stages.cap.gap import EdgeWatch
from mushpipe.stages.cap.kin import FEWEST, kin_of, unlike
from mushpipe.stages.cap.model import ASPECT, ASPECT_SIGMA
from mushpipe.stages.cap.order import Order, by_depth
from mushpipe.stages.cap.sight import drop_unseen
from mushpipe.stages.cap.solve import Habit, Noise
from mushpipe.stages.cap.verify import chances, lone_chances
from mushpipe.stages.cap_decode import first_of_each
from mushpipe.stages.discs import discs_of
from mushpipe.stages.phase.learned import seen_by
from mushpipe.stages.surface_fit import fit_tops, sources, variance_along, without_tip
from mushpipe.stages.upright import Up, pixel_rays, upright
from mushpipe.stages.warm_up import example_circles, example_frame

LEAST = 8  # points that a surface over a hole needs
_SAME = 0.6  # IoU of two circles that are one cap
_HIGHEST = 0.9  # aspect h/R: below its rim even a higher cap is no ball, and shows some tilt


class CapFit(Stage):
    """Fits a spheroid cap to the depth in each circle: axis, apex, diameter, with sigmas.

    Eight parameters are fitted to block means of the depth, along their rays; to the depth edge and
    the circle, which touch the cap; and to what caps are like. Nearer mushrooms' circles hide what
    they cover. Over a hole at the centre the position is that of `surface-fit`. Where tilt cannot
    be seen the sigma says so. A mushroom with hardly any depth, or whose fit the camera cannot have
    seen in its circle, is ``missing`` and has no pose. Circles are handed on improved: drawn to the
    outline of the fitted cap where the image shows little of it. With `min_score` it decides, too,
    which of them are caps: by their fits, by how they look beside the others, for which it needs no
    depth, and by what a network sees there whose circles it is given as well.
    """

    up: Up = "bed"
    tilt_deg: float = Field(
        25.0, gt=0, le=90, description="spread of the tilt off the upright, degrees"
    )
    depth_bias_mm: float = Field(
        0.0, ge=-20, le=20, description="taken off the depth; 2.85 for the SR300 of the paper"
    )
    depth_noise_mm: float = Field(0.3, ge=0, description="sigma of depth at the camera, mm")
    depth_noise_per_m: float = Field(1.2, ge=0, description="its growth with depth, mm per m")
    edge_offset_px: float = Field(
        0.7, ge=-3, le=3, description="how much of a cap's edge the depth camera loses, px"
    )
    circle_sigma_px: float = Field(1.0, gt=0, description="sigma of the circles, px")
    outline_sigma_px: float = Field(
        1.0, gt=0, description="sigma of the outline in the colour image, alignment included, px"
    )
    min_points: int = Field(8, ge=6, le=97, description="fewest of 97 points a fit needs")
    min_score: float | None = Field(
        None,
        ge=0,
        le=1,
        description="renew the scores of phase-hough by what the fits tell, by how like the sure "
        "caps circles look and by those of cap-net, if they are an input, and leave out those "
        "below this one; null keeps all, with their scores",
    )

    _edges: EdgeWatch = PrivateAttr(default_factory=EdgeWatch)

    def open(self) -> None:
        """Compile the kernels, and read the verifier if it is asked."""
        frame, circles = example_frame(), example_circles()
        self.process(frame, circles)
        if self.min_score is not None:
            self.scores(frame, circles.take(np.zeros(FEWEST, np.intp)), learned=circles)
        self._edges = EdgeWatch()

    def process(
        self, frame: RgbdFrame, circles: Circles, learned: Circles | None = None
    ) -> tuple[Locations, Poses, Circles]:
        """Return one location and one pose per circle, and the circles, improved.

        Args:
            frame: What they were found in, with depth if there is any.
            circles: As detected.
            learned: Circles of `cap-net`, as evidence; nothing without `min_score`.

        Raises:
            InputError: The frame has depth but no calibration.
        """
        if frame.depth is None or not len(circles):
            unknown = Locations.unknown(len(circles)), Poses.unknown(len(circles))
            scored = Circles(
                circles.center, circles.radius, self.scores(frame, circles, None, learned)
            )
            return self._kept(*unknown, scored)
        camera, depth = calibration_of(frame), frame.depth_m
        order = by_depth(depth, discs_of(circles))
        fits = self.fit(frame.gray, depth, camera, circles, order)
        score = self.scores(frame, circles, fits, learned)
        circles = Circles(fits.circle[:, :2], fits.circle[:, 2], score)
        source = np.where(fits.valid, sources(circles, depth), DepthSource.MISSING)
        holes = np.flatnonzero(source == DepthSource.NEIGHBOURS)
        if len(holes):
            self._bridge(holes, fits, depth, camera, circles, order)
        found = self._kept(_locations(fits, source.astype(np.uint8)), _poses(fits), circles)
        self._edges.look(frame, found[-1], self.edge_offset_px)
        return *_beside_edges(*found[:2], self._edges.amiss_px, found[-1].radius), found[-1]

    def scores(
        self,
        frame: RgbdFrame,
        circles: Circles,
        fits: Fits | None = None,
        learned: Circles | None = None,
    ) -> Floats:
        """Return how likely circles (N,) are caps; without `min_score` the scores they have.

        Args:
            frame: What they were found in.
            circles: As detected, with the scores of `phase-hough`.
            fits: The caps fitted in them; None without depth.
            learned: Circles of `cap-net`, if there is one.
        """
        if self.min_score is None:
            return circles.score
        seen = None if learned is None else seen_by(learned, circles)
        lone = None if fits is None else lone_chances(circles, fits, seen)
        kin = kin_of(frame.color, circles, lone)
        chance = chances(circles, unlike(kin), fits, seen, lone)
        return np.where(clods(frame.color, circles, kin), np.minimum(chance, CLOD_CHANCE), chance)

    def _kept(
        self, locations: Locations, poses: Poses, circles: Circles
    ) -> tuple[Locations, Poses, Circles]:
        if self.min_score is None:
            return locations, poses, circles
        order = np.lexsort((-circles.score, np.isnan(locations.position[:, 2])))
        likely = order[circles.score[order] >= self.min_score]
        # A part of a cap that was doubted may have become the cap; what has a position stays.
        rows = np.sort(likely[first_of_each(discs_of(circles.take(likely)), _SAME)])
        return locations.take(rows), poses.take(rows), circles.take(rows)

    def fit(
        self,
        gray: Singles,
        depth: Singles,
        camera: Camera,
        circles: Circles,
        order: Order | None = None,
    ) -> Fits:
        """Return the fitted caps themselves.

        Args:
            gray: (H, W) luma, 0..1.
            depth: (H, W) m, missing where not above 0.
            camera: Intrinsics.
            circles: Outlines, px.
            order: From `by_depth`, if that is known.
        """
        rays, discs = pixel_rays(camera), discs_of(circles)
        noise = Noise(
            shape=0.027,
            outline=0.03,
            circle_px=self.circle_sigma_px,
            aspect_sigma=ASPECT_SIGMA,
            bulge=0.0,
            bulge_sigma=0.08,
            firm=15.0,
            usual=0.25,
        )
        sensor = Sensor(
            noise=self.depth_noise_mm / 1000,
            growth=self.depth_noise_per_m / 1000,
            bias=self.depth_bias_mm / 1000,
            edge=self.edge_offset_px,
        )
        rank, ranks = order or by_depth(depth, discs)
        x, y, z = upright(self.up, depth, rays).tolist()
        fits = fit_caps(
            Frame(gray, Image(depth, rays, ranks, camera.focal)),
            discs,
            rank,
            Habit((x, y, z), float(np.radians(self.tilt_deg)), ASPECT),
            Settings(noise, sensor, self.outline_sigma_px, self.min_points),
        )
        drop_unseen(fits, discs, camera)
        return fits

    def _bridge(
        self,
        holes: Rows,
        fits: Fits,
        depth: Singles,
        camera: Camera,
        circles: Circles,
        order: Order,
    ) -> None:
        """Put the surface over holes at a centre, as `surface-fit` does: spheroids have no tip."""
        discs = discs_of(circles)
        noise = (self.depth_noise_mm / 1000, self.depth_noise_per_m / 1000)
        surface, covariance, _ = fit_tops(depth, camera, discs, noise, LEAST, holes, order)
        top = surface[:, 0] - self.depth_bias_mm / 1000
        points = camera.deproject(discs[holes, :2], top)
        fitted = np.isfinite(points).all(axis=1)  # beyond the image a lens may have no ray
        tops, rows, z = (surface[fitted], covariance[fitted]), holes[fitted], top[fitted]
        discs = discs[rows]
        size, pixel = discs[:, 2] * z / camera.focal, self.circle_sigma_px * z / camera.focal
        along = variance_along(without_tip(*tops)[0], tops[1], size, pixel)
        fits.surface[rows] = points[fitted]
        fits.sigma_surface[rows, 2] = np.maximum(fits.sigma_surface[rows, 2], np.sqrt(along))


def _locations(fits: Fits, source: Bytes) -> Locations:
    return Locations(
        position=fits.surface,
        distance=lengths(fits.surface),
        diameter=2 * fits.radius,
        source=source,
        sigma_position=fits.sigma_surface,
        sigma_diameter=2 * fits.sigma_radius,
    )


def _poses(fits: Fits) -> Poses:
    return Poses(
        quaternion=quaternion_from_axis(fits.axis),
        axis=fits.axis,
        apex=fits.apex,
        sigma_rad=_sigma_tilt(fits),
        fitness=fits.fitness,
        valid=fits.valid,
    )


def _beside_edges(
    locations: Locations, poses: Poses, amiss_px: float, radius: Floats
) -> tuple[Locations, Poses]:
    """Return both with wider sigmas where edges in depth are off by so much, of caps so large, px.

    Where a rim is off by a share of its radius, a tilt is by `LEVER` of that; of a diameter the
    outline in colour holds half.
    """
    if not amiss_px:
        return locations, poses
    share = amiss_px / radius
    size = np.hypot(locations.sigma_diameter, share * locations.diameter / 2)
    tilt = np.hypot(poses.sigma_rad, LEVER * share)
    return replace(locations, sigma_diameter=size), replace(poses, sigma_rad=tilt)


def _sigma_tilt(fits: Fits) -> Floats:
    """Return the sigma (N,) of the tilt, rad, with what not knowing how high a cap is does to it.

    The variance of the tilt goes by g(a) = 1 / (1 - a^2)^2 with the aspect a = h/R, for a cap as
    high as wide shows none (docs/pose.md, "What can be seen"). The fit took its own a for the true
    one; with the variance v of that, g is g + v g''/2 in the mean, to second order.
    """
    a = fits.height / fits.radius
    radius, height = fits.covariance[:, 5, 5], fits.covariance[:, 6, 6]
    both = fits.covariance[:, 5, 6]
    variance = (height - 2 * a * both + a**2 * radius) / fits.radius**2
    square = np.minimum(a, _HIGHEST) ** 2
    growth = 4 / (1 - square) + 24 * square / (1 - square) ** 2  # g''/g
    return np.asarray(fits.sigma_tilt * np.sqrt(1 + variance * growth / 2))
