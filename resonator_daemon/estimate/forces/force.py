"""Force from a frequency by eq. (1), and the bound of what a touch between sites leaves unobserved."""

import numpy as np

from resonator_daemon.base.arrays import Floats

GRID_STEPS = 128  # positions across the longer side of an outline
LEVEL_MARGIN = 0.5  # a site with half the largest share can still be the one that a corner captures


def force_newton(f0_hz: Floats, frequency_hz: Floats, sensitivity: Floats) -> Floats:
    """Force by (f - f0) / f = K F, the shift normalised by f, for signed `sensitivity` K in 1/N; shapes broadcast."""
    return (1.0 - f0_hz / frequency_hz) / sensitivity


def positions_inside(outline_m: Floats) -> Floats:
    """Positions of a regular grid inside the polygon `outline_m` (p, 2), as (n, 2)."""
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    pitch_m = float((high - low).max()) / GRID_STEPS
    axes = [np.arange(low[i] + pitch_m / 2, high[i], pitch_m) for i in (0, 1)]
    x, y = (axis.ravel() for axis in np.meshgrid(*axes))
    inside = np.zeros(x.shape, dtype=bool)
    for (x0, y0), (x1, y1) in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        if y0 != y1:  # even-odd rule: a ray along +x crosses this edge
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return np.stack([x[inside], y[inside]], axis=1)


def hidden_fraction(site_positions_m: Floats, outline_m: Floats, exponent: float) -> Floats:
    """Largest force that a touch can hide from each site, per newton that the site reports; shape (m,).

    Model: a touch at distance d_j from site j loads it with the share d_j^-exponent / sum_i d_i^-exponent. One captured
    tone reports the share of one site as if it were the whole, so it hides (1/share - 1) times what it reports. The
    bound for site m is taken over every position of the outline (p, 2) where a corner may capture m: where its share
    is at least half of the largest, because levels differ from corner to corner.
    """
    positions = positions_inside(outline_m)
    # Shares relative to the nearest site's keep powers of small distances within range.
    distance_m = [np.linalg.norm(positions - site, axis=1) + 1e-12 for site in site_positions_m]
    nearest_m = np.minimum.reduce(distance_m)
    relative = [(nearest_m / d) ** exponent for d in distance_m]
    total = np.add.reduce(relative)
    bound = np.zeros(len(relative))
    for m, share in enumerate(relative):
        detected = share >= LEVEL_MARGIN
        bound[m] = np.max(total[detected] / share[detected] - 1.0, initial=0.0)
    return bound


def cell_std_m(site_positions_m: Floats, outline_m: Floats) -> Floats:
    """Spread of the touches nearest to each site, per axis about the site: rms over its cell of the outline; (m, 2)."""
    positions = positions_inside(outline_m)
    nearest = np.argmin([np.sum((positions - site) ** 2, axis=1) for site in site_positions_m], axis=0)
    spread = np.zeros(site_positions_m.shape)
    for m, site in enumerate(site_positions_m):
        cell = positions[nearest == m] - site
        if len(cell):
            spread[m] = np.sqrt(np.mean(cell**2, axis=0))
    return spread
