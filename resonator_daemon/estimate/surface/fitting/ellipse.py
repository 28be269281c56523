"""Contact over an ellipse in partial slip: signals and least squares.

Hertz's pressure over an ellipse with the short half-axis a and foci at +- c about its centre is a sum of even pressures
over discs that touch its rim from inside: the disc about u c, -1 < u < 1, has the radius a sqrt(1 - u^2) and the share
3/4 (1 - u^2) du of the force. (The discs that cover a place are those of an interval of u; its length goes as Hertz's
pressure.) The part that sticks is the ellipse scaled by m^(1/3), as in a round contact.

Parameters are those of a round contact, x, y, a, F_x, F_y, F_z, m, followed by c_x, c_y.
"""

import math
from collections.abc import Callable, Mapping
from itertools import product

import numpy as np
from scipy.special import roots_jacobi

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.slip_problem import Frame, Linearisation, SlipProblem, Whitening
from resonator_daemon.estimate.surface.fitting.slip_signals import MARGIN, PARAMETERS, ROWS

_SIZE = PARAMETERS + 2
_PLACES, _WEIGHTS = roots_jacobi(10, 1, 1)  # error 0.2 % of the signals where foci are 7 depths apart, 0.01 % at 4
_NODES = list(zip(_PLACES.tolist(), (0.75 * _WEIGHTS).tolist(), strict=True))
_MARGINS = 1e-4, 0.99  # margins outside do not change the signals
_MARGIN_PRECISION = 12.0  # of one that the signals do not determine
_NO_PRESSURE = 1e-9  # share of the normal force for discs that carry only shear


class EllipseLinearisation(Linearisation):
    """As `Linearisation`, of one contact over an ellipse; the power of `model` is 0."""

    size = _SIZE

    def __init__(self, model: DiscModel, parameters: Floats, whitening: Whitening) -> None:
        self.parameters = parameters
        self.whitening = whitening
        x, y, a, force_x, force_y, force_z, margin, focus_x, focus_y = parameters.tolist()
        excess, per_m = margin / (1.0 - margin), 1.0 / model.depth_m
        change, ratio = 1.0 / (1.0 - margin) ** 2, margin ** (1.0 / 3.0)
        discs = np.empty((2 * len(_NODES), ROWS, whitening.factors.size), np.float32)
        combined = np.zeros((1 + _SIZE, *discs.shape[:2]), np.float32)  # from the rows of discs to own rows
        parts = ((1.0, 1.0 + excess, 1.0, change, 0.0), (ratio, -excess, _NO_PRESSURE, -change, ratio / (3.0 * margin)))
        for index, (part, (u, share)) in enumerate(product(parts, _NODES)):
            scale, shear, press, by_margin, scale_by_margin = part
            width = math.sqrt(1.0 - u * u)
            force = share * shear * force_x, share * shear * force_y, share * press * force_z
            place = x + scale * u * focus_x, y + scale * u * focus_y, scale * width * a
            model.slip.fill(np.array([*place, *force, 0.0]), whitening.factors, discs[index])
            into = combined[:, index]
            into[0, 0] = 1.0
            into[1, 3] = into[2, 4] = -per_m
            into[3, 1] = per_m * scale * width
            into[4, 5] = into[5, 6] = share * shear
            into[6, 7] = 1.0 / force_z if press == 1.0 else 0.0
            into[7, 1] = per_m * scale_by_margin * width * a
            into[7, 3:5] = -per_m * scale_by_margin * u * focus_x, -per_m * scale_by_margin * u * focus_y
            into[7, 5:7] = share * by_margin * force_x, share * by_margin * force_y
            into[8, 3] = into[9, 4] = -per_m * scale * u
        self.rows = combined.reshape(1 + _SIZE, -1) @ discs.reshape(-1, whitening.factors.size)
        self.value, self.scale, self.slopes = self.rows[0], np.ones(_SIZE), np.arange(1, 1 + _SIZE)
        self.precision = (self.rows[1:] @ self.rows[1:].T).astype(np.float64)
        self.precision[MARGIN, MARGIN] += _MARGIN_PRECISION


class EllipseProblem(SlipProblem):
    """As `SlipProblem`, of one contact over an ellipse whose friction is not known.

    Parameters
    ----------
    model
        Of the power 0.
    frame
    pause
        Called before each linearisation, which takes about 3 ms.
    """

    _size = _SIZE
    _rounds = 3

    def __init__(self, model: DiscModel, frame: Frame, pause: Callable[[], None]) -> None:
        super().__init__(model, frame, [None])
        self._pause = pause

    def _linearised(self, parameters: Floats) -> EllipseLinearisation:
        self._pause()
        return EllipseLinearisation(self._model, parameters, self.frame.whitening)

    def _bounds(self, parameters: Floats, held: Mapping[int, float]) -> tuple[Floats, Floats]:
        lower, upper = super()._bounds(parameters[:PARAMETERS], held)
        lower[MARGIN], upper[MARGIN] = max(lower[MARGIN], _MARGINS[0]), min(upper[MARGIN], _MARGINS[1])
        reach = np.full(2, self._model.margin_m / 2.0)
        return np.append(lower, -reach), np.append(upper, reach)
