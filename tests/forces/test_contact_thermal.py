import numpy as np
import pytest

from resonator_daemon.forces.contact_thermal import cooling_std, warming_std

SLOPE = -3e-7
TRANSIENT_S = -2e-7


def integrated(contact_kelvin, held_s, released_s, slope, transient_s, relaxation_s, steps=20_000):
    """Shift of a site after contact and release, its temperature by fourth-order Runge-Kutta."""
    temperature = 0.0
    for duration_s, drive in ((held_s, contact_kelvin), (released_s, 0.0)):
        h = duration_s / steps
        for _ in range(steps if duration_s else 0):
            k1 = (drive - temperature) / relaxation_s
            k2 = (drive - temperature - h / 2 * k1) / relaxation_s
            k3 = (drive - temperature - h / 2 * k2) / relaxation_s
            k4 = (drive - temperature - h * k3) / relaxation_s
            temperature += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    rate = ((contact_kelvin if released_s is None or released_s == 0 else 0.0) - temperature) / relaxation_s
    return slope * temperature + transient_s * rate


@pytest.mark.parametrize("slope", [-3e-7, 2e-9, 1e-7])
@pytest.mark.parametrize("held_s", [0.0, 0.3, 4.0, 600.0])
def test_a_held_contact_shifts_its_site_as_the_heat_equation_says(slope, held_s):
    expected = abs(integrated(3.0, held_s, 0.0, slope, TRANSIENT_S, 5.0))
    stated = warming_std(held_s, slope, 3.0, transient_s=TRANSIENT_S, relaxation_s=5.0)
    assert stated == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("released_s", [1e-9, 2.0, 20.0])
@pytest.mark.parametrize("held_s", [0.5, 7.0])
def test_a_released_site_cools_as_the_heat_equation_says(held_s, released_s):
    expected = abs(integrated(3.0, held_s, released_s, SLOPE, TRANSIENT_S, 4.0))
    stated = cooling_std(held_s, released_s, SLOPE, 3.0, transient_s=TRANSIENT_S, relaxation_s=4.0)
    assert stated == pytest.approx(expected, rel=1e-6)


def test_a_finger_of_three_kelvin_ends_at_its_static_shift():
    # 0.3 ppm/K times 3 K: 9e-7, 143 mN at 6.3e-6 / N.
    stated = warming_std(600.0, SLOPE, 3.0)
    assert stated / 6.3e-6 == pytest.approx(0.143, rel=0.01)


def test_random_contact_temperatures_have_the_stated_spread():
    rng = np.random.default_rng(6)
    shifts = [integrated(3.0 * z, 2.0, 0.0, SLOPE, TRANSIENT_S, 5.0, steps=50) for z in rng.normal(size=4000)]
    assert warming_std(2.0, SLOPE, 3.0) == pytest.approx(np.std(shifts), rel=0.04)


@pytest.mark.parametrize(
    ("held_s", "std_kelvin", "relaxation_s", "name"),
    [(-1.0, 3.0, 5.0, "time of -1.0 s"), (1.0, -3.0, 5.0, "contact_std_kelvin"), (1.0, 3.0, 0.0, "relaxation_s")],
)
def test_impossible_times_and_spreads_are_refused(held_s, std_kelvin, relaxation_s, name):
    arguments = held_s, SLOPE, std_kelvin
    with pytest.raises(ValueError, match=name):
        warming_std(*arguments, relaxation_s=relaxation_s)
    with pytest.raises(ValueError, match=name):
        cooling_std(1.0, *arguments, relaxation_s=relaxation_s)
