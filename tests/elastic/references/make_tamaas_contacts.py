"""Make tamaas_contacts.npz: partial slip under a rigid paraboloid on a periodic, compressible body, by tamaas.

Run in an environment of its own, which need not know this project (made with tamaas 2.9.0 and numpy 2.4.6):

    python -m venv peer && peer/bin/pip install tamaas
    peer/bin/python tests/elastic/references/make_tamaas_contacts.py

Pressure and shear come at once, on an unloaded body. Lengths are in pitches and tractions in Young's moduli: in SI
units the solvers' steps run away. PolonskyKeerTan settles to 1e-8 in some hundred iterations, though the error it
prints does not tell; Condat, of the same law, takes some thousand for 1e-3. tamaas' surface has x first and components
last; here arrays are (component, y, x).
"""

from pathlib import Path

import numpy as np
import tamaas

from resonator_daemon.arrays import Floats

PIXELS = 32
RADIUS_OF_CURVATURE_PITCHES = 50.0
# Poisson's ratio, coefficient of friction, share of the greatest shear load and its direction in degrees
CASES = [(0.3, 0.5, 0.875, 30.0), (0.0, 0.3, 0.6, -55.0)]
CONTACT_RADIUS_PITCHES = 6.25  # of Hertz, without friction or images


def load(poisson_ratio: float, friction_coefficient: float, share: float, degrees: float) -> Floats:
    """Loads x, y, z in Young's moduli times squares of the pitch."""
    stiffness = 1.0 / (1.0 - poisson_ratio**2)
    normal = 4.0 * stiffness * CONTACT_RADIUS_PITCHES**3 / (3.0 * RADIUS_OF_CURVATURE_PITCHES)
    along = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
    return np.array([*(share * friction_coefficient * normal * along), normal])


def traction(case: tuple[float, float, float, float]) -> Floats:
    """Tractions (3, ny, nx) in Young's moduli."""
    axis = np.arange(PIXELS) - (PIXELS - 1) / 2.0
    profile = (axis**2 + axis[:, None] ** 2) / (2.0 * RADIUS_OF_CURVATURE_PITCHES)
    model = tamaas.Model(tamaas.model_type.surface_2d, [float(PIXELS)] * 2, [PIXELS] * 2)
    model.E, model.nu = 1.0, case[0]
    solver = tamaas.PolonskyKeerTan(model, -profile, 1e-12, case[1])
    solver.max_iter = 1000
    solver.solve(list(load(*case) / PIXELS**2))
    return np.ascontiguousarray(np.moveaxis(np.array(model.traction), [-1, -2, -3], [-3, -2, -1]))


if __name__ == "__main__":
    tamaas.set_log_level(tamaas.LogLevel.error)
    np.savez_compressed(
        Path(__file__).with_name("tamaas_contacts.npz"),
        made_with=f"tamaas {tamaas.__version__}, numpy {np.__version__}",
        radius_of_curvature_pitches=RADIUS_OF_CURVATURE_PITCHES,
        poisson_ratio=[case[0] for case in CASES],
        friction_coefficient=[case[1] for case in CASES],
        load=[load(*case) for case in CASES],
        traction=[traction(case) for case in CASES],
    )
