"""Depth and modulus of a skin, from presses of a ball anywhere on it: one joint fit.

The shape of a contact contradicts a wrong depth or modulus; only a known load contradicts a wrong gain, which scales
all forces alike. Depth and modulus are common to all presses; place, radius, forces and slip are of each.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart
from resonator_daemon.estimate.surface.fitting.slip_problem import Frame, Linearisation, SlipProblem
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_Z, MARGIN, PARAMETERS, RADIUS
from resonator_daemon.estimate.surface.fitting.systematic import skin_changes
from resonator_daemon.estimate.surface.skin import Skin

_ROUNDS = 8
_SETTLED = 0.05  # standard deviations
_STEP_MAX = 0.1  # of a logarithm: the model is good to second order within
_ANY_MARGIN = 12.0  # precision of one that may be anything from 0 to 1
_GAIN_SHARE = (
    0.2  # of the gains' standard deviation, that depth and modulus may be off by: gains are those of all presses
)


@dataclass(frozen=True)
class Press:
    """One press: its signals and their noise, (3, n) each, and about where it is."""

    signals: Floats
    noise_std: Floats
    start: ContactStart


@dataclass(frozen=True)
class SkinFit:
    """What presses show of a skin."""

    skin: Skin  # with depth and modulus as found, and their standard deviations
    normal_newton: Floats  # of each press
    radius_m: Floats  # of contact, likewise
    chi2: Floats  # likewise, per degree of freedom


def fit_skin(skin: Skin, presses: Sequence[Press], radius_max_m: float) -> SkinFit:
    """Fit depth and modulus of a skin to presses.

    Raises
    ------
    ValueError
        No press, or a shape that does not fit.
    """
    if not presses:
        raise ValueError("presses is empty, must have at least one")
    parameters: list[Floats | None] = [None] * len(presses)
    stated_pascal = skin.half_space.youngs_modulus_pascal  # by which the first of the signals is divided
    for _ in range(_ROUNDS):
        model = DiscModel(skin.half_space, skin.site_positions_m, skin.depth_m, radius_max_m)
        information, gradient, chi2 = np.zeros((2, 2)), np.zeros(2), np.zeros(len(presses))
        for index, press in enumerate(presses):
            scale = np.array([[stated_pascal / skin.half_space.youngs_modulus_pascal], [1.0], [1.0]])
            problem = SlipProblem(model, Frame(model, press.signals * scale, press.noise_std * scale, None), [None])
            before = parameters[index]
            found = problem.from_starts([press.start]) if before is None else problem.from_parameters(before, {})
            at = Linearisation(model, found.parameters, problem.frame.whitening)
            residual = problem.frame.target - at.value
            precision = at.precision.copy()
            precision[MARGIN, MARGIN] += _ANY_MARGIN
            changes = skin_changes(skin, at)
            shared = at.project(changes)  # (7, 2)
            own = linalg.solve(precision, np.column_stack([shared, at.project(residual)]), assume_a="sym")
            information += changes.astype(np.float64) @ changes.T - shared.T @ own[:, :2]
            gradient += changes @ residual - shared.T @ own[:, 2]
            chi2[index] = found.chi_square / max(problem.count - PARAMETERS, 1)
            parameters[index] = found.parameters
        std = np.sqrt(np.linalg.inv(information).diagonal() * max(float(chi2.mean()), 1.0))
        step = np.clip(np.linalg.solve(information, gradient), -_STEP_MAX, _STEP_MAX)
        whole = np.hypot(std, _GAIN_SHARE * skin.gain_std)
        depth_m, modulus = skin.depth_m, skin.half_space.youngs_modulus_pascal
        skin = replace(
            skin,
            half_space=replace(skin.half_space, youngs_modulus_pascal=modulus * float(np.exp(step[1]))),
            depth_m=depth_m * float(np.exp(step[0])),
            depth_std_m=depth_m * float(whole[0]),
            modulus_std_pascal=modulus * float(whole[1]),
        )
        if (np.abs(step) < _SETTLED * std).all():
            break
    table = np.array(parameters)
    return SkinFit(skin, table[:, FORCE_Z], table[:, RADIUS], chi2)
