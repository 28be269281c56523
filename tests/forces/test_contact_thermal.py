import pytest

from resonator_daemon.forces.contact_thermal import warming_std

TRANSIENT_S = -2e-7


def integrated(contact_kelvin, held_s, slope, relaxation_s, steps=20_000):
    """Shift of a site under a contact, its temperature by fourth-order Runge-Kutta."""
    temperature, h = 0.0, held_s / steps
    for _ in range(steps):
        k1 = (contact_kelvin - temperature) / relaxation_s
        k2 = (contact_kelvin - temperature - h / 2 * k1) / relaxation_s
        k3 = (contact_kelvin - temperature - h / 2 * k2) / relaxation_s
        k4 = (contact_kelvin - temperature - h * k3) / relaxation_s
        temperature += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return slope * temperature + TRANSIENT_S * (contact_kelvin - temperature) / relaxation_s


@pytest.mark.parametrize("slope", [-3e-7, 2e-9, 1e-7])
@pytest.mark.parametrize("held_s", [0.0, 0.3, 4.0, 600.0])
def test_a_held_contact_shifts_its_site_as_the_heat_equation_says(slope, held_s):
    expected = abs(integrated(3.0, held_s, slope, 5.0))
    stated = 3.0 * warming_std(held_s, slope, TRANSIENT_S, 5.0)
    assert stated == pytest.approx(expected, rel=1e-6)
