"""Coupled partial slip against frozen tractions of tamaas, made by references/make_tamaas_contacts.py."""

from pathlib import Path

import numpy as np
import pytest
from paraboloid_contact import squared_radius

from resonator_daemon.elastic import HalfSpace
from resonator_daemon.elastic.friction import FrictionalContact, FrictionState
from resonator_daemon.elastic.influence import SurfaceCompliance


@pytest.mark.parametrize("number", range(2))
def test_coupled_periodic_contact_is_that_of_tamaas(number: int):
    with np.load(Path(__file__).with_name("references") / "tamaas_contacts.npz") as reference:
        expected, load = reference["traction"][number], reference["load"][number]
        nu, mu = float(reference["poisson_ratio"][number]), float(reference["friction_coefficient"][number])
        curvature_pitches = float(reference["radius_of_curvature_pitches"])

    def solve(finer: int) -> FrictionState:
        pixels, pitch_m = 32 * finer, 1.0 / finer
        contact = FrictionalContact(
            SurfaceCompliance(HalfSpace(1.0, nu), (pixels, pixels), pitch_m, periodic=True),
            squared_radius(pixels, pitch_m) / (2 * curvature_pitches),
            mu,
        )
        return contact.step(contact.apart, load_newton=load)

    state = solve(1)
    found = state.traction_pascal
    slips = np.hypot(*expected[:2]) >= mu * expected[2] * (1 - 1e-9)
    np.testing.assert_array_equal(state.sticks | state.slips, expected[2] > 0)
    np.testing.assert_array_equal(state.slips, slips & (expected[2] > 0))
    # Same grid, same law: they differ in the odd terms at Nyquist frequencies, which tamaas keeps. That is less than a
    # tenth of what either changes on a grid twice as fine.
    apart = np.linalg.norm(found - expected, axis=(1, 2)).max() / np.linalg.norm(expected)
    finer = solve(2).traction_pascal.reshape(3, 32, 2, 32, 2).mean(axis=(2, 4))
    assert apart < 2e-3
    assert 10 * apart < np.linalg.norm(finer - found) / np.linalg.norm(found) < 0.05
