"""The score of a skin: tractions and contacts of hand-made messages against hand-made truth."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from score_run import PITCH_M, SITES_M, Run, touch


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Windows of two frames."""
    run = Run(tmp_path / "truth.jsonl", touched_anywhere=True)
    yield run
    run.close()


# Traction error: sqrt(sum err^2 / sum truth^2) pooled over frames whose net force exceeds 5 % of the peak.

SHAPE = NY, NX = 16, 20


def hertz(newton: float, x_m: float = 0.0, y_m: float = 0.0) -> NDArray[np.float64]:
    """Tractions (3, ny, nx) of a press without shear, radius 2.5 mm at 1 N, averaged by 24 x 24 points in a pixel."""
    a = 2.5e-3 * newton ** (1 / 3)
    x = ((np.arange(NX * 24) + 0.5) / 24 - NX / 2) * PITCH_M - x_m
    y = ((np.arange(NY * 24) + 0.5) / 24 - NY / 2) * PITCH_M - y_m
    pressure = 3 * newton / (2 * math.pi * a**2) * np.sqrt(np.maximum(1 - (x**2 + y[:, None] ** 2) / a**2, 0.0))
    return np.array([np.zeros(SHAPE), np.zeros(SHAPE), pressure.reshape(NY, 24, NX, 24).mean(axis=(1, 3))])


def skin_touch(f_z: float, **touched: Any) -> dict[str, Any]:
    return touch(f_z, site=None, **touched)


def test_a_true_map_has_no_error_and_a_shifted_one_has(run: Run) -> None:
    run.decoded(run.truth(skin_touch(1.0, position_m=(1e-3, -6e-4))), hertz(1.0, 1e-3, -6e-4))
    assert run.result().traction_error == pytest.approx(0.0, abs=2e-3)
    run.decoded(run.truth(skin_touch(1.0, position_m=(1e-3, -6e-4))), hertz(1.0, -6e-4, 1e-3))
    assert (run.result().traction_error or 0.0) > 0.3


def test_tractions_are_pooled_over_frames_before_the_ratio(run: Run) -> None:
    errors = np.zeros((2, 3, *SHAPE))
    errors[0, 0, 3, 5], errors[0, 2, 8, 8] = 30e3, -40e3
    errors[1, 1] = 2e3
    for newton, error in zip((0.4, 1.0), errors, strict=True):
        run.decoded(run.truth(skin_touch(newton)), hertz(newton) + error)
    squares = 30e3**2 + 40e3**2 + NY * NX * 2e3**2
    truth = np.sum(hertz(0.4) ** 2) + np.sum(hertz(1.0) ** 2)
    assert run.result().traction_error == pytest.approx(math.sqrt(squares / truth), rel=5e-3)


def test_weak_frames_and_untouched_ones_do_not_count(run: Run) -> None:
    wild = np.full((3, *SHAPE), 1e5)
    run.decoded(run.truth(), wild)
    run.decoded(run.truth(skin_touch(0.049)), wild)
    run.decoded(run.truth(skin_touch(1.0)), np.zeros((3, *SHAPE)))
    assert run.result().traction_error == pytest.approx(1.0)
    # Of 0.045 N and 0.0225 N of shear, the net force is 0.0503 N.
    run.decoded(run.truth(skin_touch(0.045, shear=(0.0135, -0.018))), wild)
    assert (run.result().traction_error or 0.0) > 3.0


def test_a_map_of_scattered_sites_is_compared_point_by_point(run: Run) -> None:
    number = run.truth(skin_touch(1.0, shear=(0.2, 0.0)))
    a, p_0 = 2.5e-3, 1.5 / (math.pi * 2.5e-3**2)
    c = a * (1 - 0.2 / 0.5) ** (1 / 3)
    r = np.linalg.norm(SITES_M, axis=1)
    pressure, stuck = (np.sqrt(np.maximum(1 - (r / radius) ** 2, 0.0)) for radius in (a, c))
    true = p_0 * np.array([0.5 * (pressure - stuck * c / a), np.zeros(4), pressure])  # Cattaneo and Mindlin
    assert true[2].tolist() == pytest.approx([p_0, 0.8 * p_0, 0.6 * p_0, 0.0])
    run.decoded(number, true, grid=False)
    assert run.result().traction_error == pytest.approx(0.0, abs=1e-6)
    run.decoded(number, true + np.array([[0.0], [3e3], [0.0]]), grid=False)
    assert run.result().traction_error == pytest.approx(math.sqrt(4 * 3e3**2 / (2 * np.sum(true**2))), rel=1e-5)


# Contacts of a skin: normal force and position of the contact nearest to each true contact, above 5 % of its peak.


def test_each_true_contact_is_compared_with_the_nearest_measured_one(run: Run) -> None:
    run.truth(skin_touch(1.0, id=1, position_m=(-2e-3, 0.0)), skin_touch(0.5, id=2, position_m=(3e-3, 1e-3)))
    run.contacts(0, ((3e-3, 1.03e-3), 0.52), ((-2.04e-3, 0.0), 0.97))
    result = run.result()
    assert result.force_error_newton_rms == pytest.approx(math.sqrt((0.02**2 + 0.03**2) / 2))
    assert result.position_error_m_rms == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2) * 1e-3)
    assert result.latency_ms == []  # of a skin it is that of `decoded`
