"""Tabulated signals below contacts anywhere, next to the closed form that the table is made of."""

import numpy as np
import pytest

from resonator_daemon.base.plate import load_plate
from simulators.contact import hertz_parts, pressed_signals
from simulators.pressed_surface import PressedSurface

RADIUS_MAX_M = 8e-3
OF_PEAK = 1e-4  # measured: 1.1e-5; two decades below the gain error of a tone


@pytest.mark.parametrize(("name", "nu"), [("skin32", 0.5), ("fingertip400", 0.5), ("fingertip400", 0.3)])
def test_random_presses_are_as_by_the_closed_form(name: str, nu: float) -> None:
    plate, random = load_plate(name), np.random.default_rng(5)
    sites_m, skin = plate.site_positions_m, plate.skin
    assert skin
    low_m, high_m = plate.outline_m.min(axis=0), plate.outline_m.max(axis=0)
    surface = PressedSurface(
        sites_m, skin.depth_m, skin.youngs_modulus_pascal, nu, float(np.hypot(*(high_m - low_m))), RADIUS_MAX_M
    )
    worst = 0.0
    for _ in range(60):
        x, y = random.uniform(low_m, high_m).tolist()
        friction, normal = random.uniform(0.05, 1.5), random.uniform(0.01, 5.0)
        radius_m = random.uniform(1e-4, RADIUS_MAX_M)
        angle, share = random.uniform(0.0, 2.0 * np.pi), random.choice([0.0, 1.0, random.uniform()])
        force = np.array([np.cos(angle), np.sin(angle), 0.0]) * share * friction * normal + [0.0, 0.0, normal]
        of_1_newton_m = radius_m / normal ** (1 / 3)
        found = surface.signals((x, y), *hertz_parts(force, of_1_newton_m, friction))
        exact = pressed_signals(
            sites_m, skin.depth_m, skin.youngs_modulus_pascal, nu, (x, y), of_1_newton_m, friction, force
        )
        peak = np.abs(exact).max(axis=1, keepdims=True)
        worst = max(worst, (np.abs(found - exact) / peak).max())
    assert worst < OF_PEAK


def test_what_is_beyond_the_table_is_an_error() -> None:
    surface = PressedSurface([(0.0, 0.0), (1e-3, 0.0)], 1e-3, 2e5, 0.5, 3e-3, 2e-3)
    with pytest.raises(ValueError, match="radius"):
        surface.signals((0.0, 0.0), *hertz_parts((0.0, 0.0, 1.0), 2.1e-3, 0.5))
    with pytest.raises(ValueError, match="site"):
        surface.signals((-2.1e-3, 0.0), *hertz_parts((0.0, 0.0, 1.0), 1e-3, 0.5))
