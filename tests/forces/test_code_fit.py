"""The fit of one reading, in plain floats, is the fit of many, in arrays."""

import numpy as np
import pytest

from resonator_daemon.forces.code_fit import (
    Channels,
    Code,
    Codes,
    fit_code,
    fit_codes,
    uncertainty_newton,
    uncertainty_of_one,
)

SITES, READINGS, CHANNELS = 5, 40, 4


@pytest.mark.parametrize("seed", range(20))
def test_one_reading_is_fitted_as_many_are(seed):
    draw = np.random.default_rng(seed)
    signs = draw.choice([-1.0, 1.0], (SITES, CHANNELS))
    sensitivity = 6.3e-6 * signs * draw.uniform(0.5, 1.5, (SITES, CHANNELS))
    codes = Codes(draw.uniform(9e6, 11e6, (SITES, CHANNELS)), sensitivity, draw.uniform(0.0, 0.05), (-0.5, 10.0))
    sites = draw.integers(SITES, size=READINGS)
    std = 10.0 ** draw.uniform(-9, -7, (READINGS, CHANNELS))
    used = draw.random((READINGS, CHANNELS)) < 0.8
    used[:, :2] = True
    pressed_newton = draw.uniform(-1.0, 12.0, READINGS)  # beyond both ends of the range, too
    shift = sensitivity[sites] * pressed_newton[:, None] + 1e-7 * draw.standard_normal((READINGS, CHANNELS))
    readings = Channels(
        np.where(used, codes.f0_hz[sites] / (1.0 - shift), 1.0),
        np.where(used, std**2, 0.0),
        np.where(used, std**-2, 0.0),
        10.0 ** draw.uniform(-20, -16, READINGS),
        10.0 ** draw.uniform(-20, -16, READINGS),
    )
    many = fit_codes(codes, sites, readings.frequency_hz, readings.inverse_variance, readings.common_variance)
    noise, systematic = uncertainty_newton(codes, sites, many.force_newton, many.weights, readings)
    for row, site in enumerate(sites.tolist()):
        code = Code(codes.f0_hz[site].tolist(), sensitivity[site].tolist())
        reading = readings.rows(slice(row, None)).first
        one = fit_code(site, code, codes.model_error, codes.range_newton, reading)
        assert one.site == site
        # Terms that nearly cancel may be added in another order.
        assert one.weights == pytest.approx(many.weights[row], rel=1e-12, abs=1e-12 * np.abs(many.weights[row]).max())
        assert one.force_newton == pytest.approx(many.force_newton[row], rel=1e-12)
        assert (one.chi2, one.score) == pytest.approx((many.chi2[row], many.score[row]), rel=1e-9)
        told = uncertainty_of_one(code.sensitivity, codes.model_error, one.force_newton, one.weights, reading)
        assert told == pytest.approx((noise[row], systematic[row]), rel=1e-12)
