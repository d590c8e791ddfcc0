"""The Chan-Vese energy that every solver minimises and every test measures.

    E(u) = 1/N [ sum_in |I - c1|^2 + sum_out |I - c2|^2 + mu Len(u) ]

(Chan & Vese 2001, eq. 9, with lambda1 = lambda2 = 1, nu = 0), c1 and c2 the means inside and
outside, N the number of pixels. Len is the Cauchy-Crofton length on the 8-neighbourhood (Boykov &
Kolmogorov 2003): pi/8 (n_h + n_v + (n_d1 + n_d2) / sqrt 2), n_* the number of unequal neighbours in
a direction. With several channels the squared differences are averaged over them.
"""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Bools, Floats, Singles


def region_means(image: Singles, region: Bools) -> tuple[Floats, Floats]:
    """Return the means (C,) inside and outside of a region; 0 for an empty side."""
    planes = image.reshape(-1, image.shape[-1]) if image.ndim == 3 else image.reshape(-1, 1)
    flat = region.ravel()
    inside = int(flat.sum())
    total = planes.sum(axis=0, dtype=np.float64)
    sum_inside = planes[flat].sum(axis=0, dtype=np.float64)
    outside = max(1, len(flat) - inside)
    return sum_inside / max(1, inside), (total - sum_inside) / outside


def contour_length(region: Bools) -> float:
    """Return the Cauchy-Crofton length of a region's contour in pixels."""
    u = region
    axial = np.count_nonzero(u[1:] != u[:-1]) + np.count_nonzero(u[:, 1:] != u[:, :-1])
    diagonal = np.count_nonzero(u[1:, 1:] != u[:-1, :-1])
    diagonal += np.count_nonzero(u[1:, :-1] != u[:-1, 1:])
    return float(np.pi / 8 * (axial + diagonal / np.sqrt(2)))


def chan_vese_energy(image: Singles, region: Bools, mu: float) -> float:
    """Return E of a region of an (H, W) or (H, W, C) image in 0..1."""
    planes = image[..., None] if image.ndim == 2 else image
    c1, c2 = region_means(image, region)
    fit = ((planes[region] - c1) ** 2).sum() + ((planes[~region] - c2) ** 2).sum()
    return float(fit / planes.shape[2] + mu * contour_length(region)) / region.size
