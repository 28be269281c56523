"""Systematic errors of a contact, by the uncertainty of a skin's depth, modulus, gains, places, and by a common mode.

By dimensional analysis, signals s of given forces obey z ds/dz = -2 s - a ds/da + (site - centre) . ds/dcentre, since
they have the form f(site / z, centre / z, a / z) / z^2. A stiffer skin has smaller strains and the same pressures; a
common gain scales all signals. The fit follows each such change by weighted least squares.
"""

from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats, Singles
from resonator_daemon.estimate.surface.fitting.slip_problem import Frame, Linearisation, Settled
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_X, MARGIN, PARAMETERS, RADIUS, X, Y
from resonator_daemon.estimate.surface.skin import Skin

_SIGNIFICANT2 = 3.0**2  # of an offset, in standard deviations: a smaller one is noise


def skin_changes(skin: Skin, at: Linearisation) -> Singles:
    """Return the whitened change of the signals by the logarithms of depth and modulus, at given forces, (2, 3 n)."""
    sites_m = skin.site_positions_m.T.astype(np.float32)
    changes = np.empty((2, 3, sites_m.shape[1]), np.float32)
    value = at.value.reshape(changes[0].shape)
    np.multiply(value, -2.0, out=changes[0])
    for contact, slopes in zip(at.parameters.reshape(-1, at.size), _slopes(at), strict=True):
        for length in (RADIUS, *range(PARAMETERS, at.size)):
            changes[0] -= float(contact[length]) * slopes[length]
        for axis in (X, Y):
            changes[0] += (sites_m[axis] - float(contact[axis])) * slopes[axis]
    changes[1, 0], changes[1, 1:] = 0.0, -value[1:]
    return changes.reshape(2, -1)


def _slopes(at: Linearisation) -> Singles:
    """Return the slopes by the parameters of each contact, (k, p, 3, n)."""
    slopes = at.rows[at.slopes] * at.scale.astype(np.float32)[:, None]
    return slopes.reshape(-1, at.size, 3, slopes.shape[1] // 3)


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
    """Return the covariance of the p parameters of each contact that the uncertainty of a skin leads to, (k, p, p).

    `at` is near the minimum of chi-square, `covariance` (p k, p k) that of its parameters for the declared noise.
    """
    forces = at.parameters.reshape(-1, at.size).copy()
    forces[:, :FORCE_X] = forces[:, MARGIN:] = 0.0
    moved = np.column_stack([covariance @ at.project(skin_changes(skin, at)), forces.ravel()])
    moved *= skin.depth_std_m / skin.depth_m, skin.modulus_std, skin.gain_std_common
    total = moved @ moved.T
    if skin.position_std_m:  # each site moves its three signals together
        slopes = _slopes(at)
        places = slopes[:, : Y + 1].sum(axis=0)  # all contacts that move are sites that move the other way
        each = np.einsum("psn,asn->pan", slopes.reshape(-1, *places.shape[1:]), places).reshape(len(total), -1)
        total += skin.position_std_m**2 * (covariance @ (each @ each.T) @ covariance.T)
    blocks = total.reshape(len(forces), at.size, len(forces), at.size)
    return np.stack([blocks[index, :, index] for index in range(len(forces))])
