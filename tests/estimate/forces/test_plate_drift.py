import numpy as np
import pytest

from resonator_daemon.estimate.forces.plate_drift import PlateDrift

SITES = 16
SENSITIVITY = -6.3e-6
NOISE_STD = 3e-9
OFFSET_STD = 2e-7
SLOPE = -3e-7
PRESSED = 3


class Plate:
    """Sixteen sites with noise, offsets, a reference error and temperature coefficients, some unknown."""

    def __init__(self, seed, *, coefficient_spread=0.0, coefficient_std=0.0, slope=SLOPE, local_std=0.0, start=None):
        self.rng = np.random.default_rng(seed)
        stated = np.array([np.full(SITES, slope), np.full(SITES, -5e-10), np.full(SITES, 1.08e-10)])
        self.coefficients = stated + np.array([coefficient_spread * self.rng.normal(size=SITES), *np.zeros((2, SITES))])
        self.offset = (OFFSET_STD if start is None else start) * self.rng.normal(size=SITES) + 1e-5
        self.thermometer_zero = 0.5 * self.rng.normal(size=SITES)
        self.local_std = local_std
        self.drift = PlateDrift(
            stated, coefficient_std=coefficient_std, offset_std=OFFSET_STD, local_kelvin_std=local_std
        )

    def shift(self, theta, force, warm=0.0, reference=0.0):
        a, b, c = self.coefficients
        kelvin = theta + warm
        shift = a * kelvin + b * kelvin**2 + c * kelvin**3 + self.offset + reference + SENSITIVITY * force
        return shift + NOISE_STD * self.rng.normal(size=SITES)

    def frame(self, dt_s, theta=0.0, force=0.0, warm=0.0, reference=0.0):
        """Reading of one frame, errors of the forces and their standard deviations in newtons."""
        shift = self.shift(theta, force, warm, reference)
        local = None
        if self.local_std:
            local = theta + warm + self.thermometer_zero + self.local_std * self.rng.normal(size=SITES)
        reading = self.drift.update(shift, np.full(SITES, NOISE_STD**2), dt_s, local)
        error = (shift - reading.expected_shift) / SENSITIVITY - force
        return reading, error, np.hypot(reading.expected_std, NOISE_STD) / abs(SENSITIVITY)

    def untouched(self, frames=200):
        for _ in range(frames):
            self.frame(0.02)
        return self


def on(newton, sites=PRESSED):
    force = np.zeros(SITES)
    force[sites] = newton
    return force


def held_for_ten_minutes(plate, theta, *, dt_s=1.0, warm_kelvin=0.0, reference=lambda t: 0.0, onset_s=30.0):
    """Errors and standard deviations of the pressed site, (frames,), and contacts found elsewhere."""
    errors, stds, elsewhere = [], [], 0
    for t in np.arange(0.0, onset_s + 600.0, dt_s):
        pressed = t >= onset_s
        warm = on(warm_kelvin * (1 - np.exp(-(t - onset_s) / 5.0))) if pressed else 0.0
        reading, error, std = plate.frame(dt_s, theta(t), on(2.0) if pressed else 0.0, warm, reference(t))
        elsewhere += np.count_nonzero(np.delete(reading.in_contact, PRESSED))
        if pressed:
            errors.append(error[PRESSED])
            stds.append(std[PRESSED])
    assert reading.in_contact[PRESSED]
    return np.array(errors), np.array(stds), elsewhere


def sinusoid(kelvin, phase=0.0, period_s=1200.0):
    return lambda t: kelvin * np.sin(2 * np.pi * t / period_s + phase)


@pytest.mark.parametrize("kelvin", [2.0, 10.0])
def test_two_newtons_held_for_ten_minutes_under_drift_stay_within_a_millinewton(kelvin):
    errors, stds, elsewhere = held_for_ten_minutes(Plate(1), sinusoid(kelvin))
    assert elsewhere == 0
    assert np.sqrt(np.mean(errors**2)) < 1e-3
    assert abs(errors[-60:].mean()) < 0.4e-3  # the last minute without their noise
    assert np.mean(np.abs(errors) <= 2 * stds) > 0.93
    assert stds[-1] < 1e-3


def test_unknown_differences_of_coefficients_are_within_what_is_reported():
    """Forty plates with a spread of 2e-8 / K, held under 2 K: the end of the contact in standard deviations."""
    ratios, stated = [], []
    for seed in range(40):
        plate = Plate(seed, coefficient_spread=2e-8, coefficient_std=2e-8)
        errors, stds, elsewhere = held_for_ten_minutes(plate, sinusoid(2.0, phase=seed), dt_s=10.0)
        assert elsewhere == 0
        ratios.append(abs(errors[-1]) / stds[-1])
        stated.append(stds[-1])
    assert np.mean(np.array(ratios) <= 2.0) >= 0.9
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.3)
    assert max(stated) < 15e-3


def test_a_warm_finger_is_made_good_for_by_the_sites_thermometer():
    errors, stds, _ = held_for_ten_minutes(Plate(3, local_std=0.01), sinusoid(2.0), warm_kelvin=3.0)
    assert np.abs(errors[-60:].mean()) < 3e-3
    assert np.abs(errors).max() < 5 * stds.max()
    assert stds[-1] < 6e-3


def test_a_site_with_a_thermometer_is_free_again_while_it_cools():
    plate = Plate(4, local_std=0.01).untouched()
    for k in range(1000):
        plate.frame(0.02, force=on(1.0), warm=on(3 * (1 - np.exp(-k * 0.02 / 5))))
    readings = [plate.frame(0.02, warm=on(3 * 0.98 * np.exp(-k * 0.02 / 5)))[0] for k in range(1200)]
    assert [r.in_contact[PRESSED] for r in readings[:6]].count(True) <= 5
    assert not any(r.in_contact.any() for r in readings[6:])


@pytest.mark.parametrize("newton", [0.05, 2.0])
def test_a_press_of_the_whole_plate_finds_all_sites_and_theta_is_held(newton):
    plate = Plate(5)
    for _ in range(200):
        before, _, _ = plate.frame(0.02)
    held = [plate.frame(0.02, force=on(newton, slice(None)))[0] for _ in range(500)]
    assert held[1].in_contact.all()
    assert held[-1].in_contact.all()
    assert held[-1].theta_kelvin == before.theta_kelvin
    assert held[-1].held_s == pytest.approx(10.0)
    assert held[-1].expected_std.min() > 3 * held[5].expected_std.max()
    after = [plate.frame(0.02)[0] for _ in range(10)]
    assert not after[-1].in_contact.any()
    assert after[-1].held_s == 0.0


def test_a_slow_press_is_not_eaten():
    plate = Plate(7).untouched()
    for k in range(1000):
        plate.frame(0.02, force=on(k / 1000 * 2.0))
    errors = [plate.frame(0.02, force=on(2.0))[1][PRESSED] for _ in range(200)]
    assert abs(np.mean(errors)) < 1e-3


def test_untouched_sites_follow_their_offsets_without_contacts():
    plate, contacts = Plate(8), 0
    errors = []
    for _ in range(1500):
        plate.offset[2] += 1e-13  # 5e-12 a second
        reading, error, _ = plate.frame(0.02)
        contacts += np.count_nonzero(reading.in_contact)
        errors.append(error)
    assert contacts == 0
    assert np.abs(np.mean(errors[-500:], axis=0)).max() < 0.1e-3


def test_a_plate_far_from_the_calibrations_temperature_starts_without_contacts():
    plate = Plate(9, coefficient_spread=2e-8, coefficient_std=2e-8)
    readings = [plate.frame(0.02, theta=25.0)[0] for _ in range(100)]
    assert not any(r.in_contact.any() for r in readings)


def test_theta_is_known_where_coefficients_differ_and_not_where_they_are_equal():
    differing = Plate(10, slope=np.linspace(-3e-7, 3e-7, SITES))
    reading, _, _ = differing.frame(0.02, theta=7.0, reference=1e-5)
    assert abs(reading.theta_kelvin - 7.0) < 3 * reading.theta_std_kelvin
    assert 0.1 < reading.theta_std_kelvin < 0.5
    equal, _, _ = Plate(10).frame(0.02, theta=7.0, reference=1e-5)
    assert equal.theta_std_kelvin > 10.0  # the reference may have done it


def test_a_site_pressed_at_the_start_is_found_and_its_offset_stays_as_uncertain_as_calibrated():
    plate = Plate(11)
    for _ in range(20):
        reading, error, std = plate.frame(0.02, force=on(2.0))
    assert reading.in_contact.tolist() == on(1.0).astype(bool).tolist()
    assert abs(error[PRESSED]) < 3 * std[PRESSED]
    assert std[PRESSED] == pytest.approx(OFFSET_STD / abs(SENSITIVITY), rel=0.1)


def test_one_outlying_frame_is_no_contact_and_is_not_learnt():
    plate = Plate(12).untouched()
    reading, _, _ = plate.frame(0.02, force=on(1.0))
    assert not reading.in_contact.any()
    errors = [plate.frame(0.02)[1][PRESSED] for _ in range(50)]
    assert abs(np.mean(errors)) < 0.4e-3


def test_sites_that_are_not_received_keep_what_was_known():
    plate = Plate(13).untouched()
    variance = np.full(SITES, NOISE_STD**2)
    variance[0] = np.nan
    for _ in range(200):
        shift = plate.shift(1.0, 0.0)
        shift[1] = np.nan
        plate.drift.update(shift, variance, 0.02)
    _, error, std = plate.frame(0.02, theta=1.0)
    assert np.abs(error).max() < 4 * std.max()
    nothing = plate.drift.update(np.full(SITES, np.nan), variance, 0.02)
    assert np.isfinite(nothing.expected_shift).all()
    assert nothing.held_s == pytest.approx(0.02)


def test_tare_takes_the_present_shifts_as_untouched():
    plate = Plate(14).untouched(100)
    for _ in range(10):
        plate.frame(0.02, force=on(0.5))
    mean = np.mean([plate.shift(0.0, on(0.5)) for _ in range(100)], axis=0)
    mean[0] = np.nan
    plate.drift.tare(mean, np.full(SITES, NOISE_STD**2 / 100))
    reading, error, _ = plate.frame(0.02, force=on(0.5))
    assert not reading.in_contact.any()
    assert error[PRESSED] == pytest.approx(-0.5, abs=3e-3)  # zero is reported
