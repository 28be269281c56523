"""Systematic errors of a contact, by the uncertainty of a skin's depth, modulus, gains, places, and by a common mode.

By dimensional analysis, signals s of given forces obey z ds/dz = -2 s - a ds/da + (site - centre) . ds/dcentre, since
they have the form f(site / z, centre / z, a / z) / z^2. A stiffer skin has smaller strains and the same pressures; a
common gain scales all signals. The fit follows each such change by weighted least squares.
"""

from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats, Singles
from resonator_daemon.estimate.surface.fitting.slip_problem import Frame, Linearisation, Settled
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_X, MARGIN, PARAMETERS, RADIUS, ROWS, Y
from resonator_daemon.estimate.surface.skin import Skin

_SIGNIFICANT2 = 3.0**2  # of an offset, in standard deviations: a smaller one is noise
_BY_X, _BY_Y = 3, 4  # rows of the slopes by the offset of a site, in depths


def skin_changes(skin: Skin, at: Linearisation) -> Singles:
    """Return the whitened change of the signals by the logarithms of depth and modulus, at given forces, (2, 3 n)."""
    sites, contacts = len(skin.site_positions_m), at.parameters.size // PARAMETERS
    rows, parameters = at.rows.reshape(contacts, ROWS, 3, sites), at.parameters.reshape(contacts, PARAMETERS)
    changes = np.empty((2, 3, sites), np.float32)
    value = at.value.reshape(3, sites)
    np.multiply(value, -2.0, out=changes[0])
    for (_, by_radius, _, by_x, by_y, *_), contact in zip(rows, parameters / skin.depth_m, strict=True):
        offset = (skin.site_positions_m.T / skin.depth_m - contact[: Y + 1, None]).astype(np.float32)
        changes[0] -= float(contact[RADIUS]) * by_radius + offset[0] * by_x + offset[1] * by_y
    changes[1, 0], changes[1, 1:] = 0.0, -value[1:]
    return changes.reshape(2, -1)


class Offset(NamedTuple):
    """Offset of each kind of signal, caused by a common mode that changes during a touch."""

    of_noise: Floats  # in units of the noise without gain errors, (3,)
    moved: Floats  # what it changes each parameter by, (7 k, 3); 0 where it is not significant
    chi2_decrease: float  # of the sum of squares, if the offset is removed


def offset_of(frame: Frame, settled: Settled, covariance: Floats, noise_std: Floats) -> Offset:
    """Return the offset that a fit leaves in the signals.

    `covariance` (7 k, 7 k) is that of the parameters for the declared noise, `noise_std` (3, n) without gain errors.
    """
    at = settled.linearisation
    moved = (settled.parameters - at.parameters) * at.scale
    left = frame.target - at.value - moved.astype(np.float32) @ at.rows[at.slopes]
    unit = (noise_std * frame.whitening.weights).astype(np.float32)
    across = np.vecdot(at.rows.reshape(len(at.rows), 3, -1), unit)[at.slopes] * at.scale[:, None]
    followed = covariance @ across
    information = np.vecdot(unit, unit) - (across * followed).sum(axis=0)
    information[information <= 0.0] = np.inf  # of signals that are all lost
    found = np.vecdot(unit, left.reshape(unit.shape)) / information
    scores2 = found**2 * np.where(np.isinf(information), 0.0, information)
    return Offset(found, followed * np.where(scores2 > _SIGNIFICANT2, found, 0.0), float(scores2.sum()))


def systematic_covariances(skin: Skin, at: Linearisation, covariance: Floats) -> Floats:
    """Return the covariance of the parameters of each contact that the uncertainty of a skin leads to, (k, 7, 7).

    `at` is near the minimum of chi-square, `covariance` (7 k, 7 k) that of its parameters for the declared noise.
    """
    contacts = at.parameters.size // PARAMETERS
    forces = at.parameters.reshape(contacts, PARAMETERS).copy()
    forces[:, :FORCE_X] = forces[:, MARGIN] = 0.0
    moved = np.column_stack([covariance @ at.project(skin_changes(skin, at)), forces.ravel()])
    moved *= skin.depth_std_m / skin.depth_m, skin.modulus_std, skin.gain_std_common
    total = moved @ moved.T
    if skin.position_std_m:  # each site moves its three signals together
        sites = len(skin.site_positions_m)
        places = at.rows.reshape(contacts, ROWS, 3, sites)[:, _BY_X : _BY_Y + 1].sum(axis=0)
        slopes = at.rows[at.slopes].reshape(-1, 3, sites)
        each = np.einsum("psn,asn->pan", slopes, places).reshape(len(slopes), -1)
        scaled = covariance * at.scale
        total += (skin.position_std_m / skin.depth_m) ** 2 * (scaled @ (each @ each.T) @ scaled.T)
    blocks = total.reshape(contacts, PARAMETERS, contacts, PARAMETERS)
    return np.stack([blocks[index, :, index] for index in range(contacts)])
