"""Tests of the projection on the friction cone: against a general optimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from resonator_daemon.estimate.surface.contact_physics.friction_cone import project_on_cone


@pytest.mark.parametrize("friction", [0.3, 1.0, 3.0])
def test_projection_is_the_nearest_traction_in_the_cone(friction):
    rng = np.random.default_rng(1)
    outside = rng.standard_normal((3, 40)).astype(np.float32)
    projected = project_on_cone(outside, friction)
    for before, after in zip(outside.T.astype(float), projected.T, strict=True):
        # In polar coordinates of the shear the cone is two straight bounds, which a general optimiser can take.
        best = minimize(
            lambda p, f=before: (p[0] - np.hypot(f[0], f[1])) ** 2 + (p[1] - f[2]) ** 2,
            [0.0, 1.0],
            constraints={"type": "ineq", "fun": lambda p: [friction * p[1] - p[0], p[0], p[1]]},
            options={"ftol": 1e-14},
        )
        direction = before[:2] / np.hypot(*before[:2])
        np.testing.assert_allclose(after, [*(best.x[0] * direction), best.x[1]], atol=2e-5)
