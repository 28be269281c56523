"""Input that holds no real numbers, or absurd ones."""

from collections.abc import Callable

import numpy as np
import pytest

from resonator_daemon.estimate.elastic.constrained import NotConvergedError
from resonator_daemon.estimate.elastic.contact import FrictionalContact, paraboloid
from resonator_daemon.estimate.elastic.fields import SurfaceFields
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from resonator_daemon.estimate.elastic.mixed import MixedBoundary, solve_regions

BODY = HalfSpace(2e5, 0.3)
PITCH = 1e-3
SURFACE = SurfaceCompliance(BODY, (8, 8), PITCH)
BOWL = paraboloid((8, 8), PITCH, 1e-2)
MIXED = MixedBoundary(BODY, SpectralGrid((8, 8), PITCH), ("f_x", "f_y", "u_z"), zero="periodic")
BODY_ON_BOWL = FrictionalContact(SURFACE, BOWL, 0.0)
IMAGES = np.zeros((3, 8, 8))


@pytest.mark.parametrize(
    "ask",
    [
        lambda bad: BODY.transfer_matrix("stress", "traction", bad(np.ones(2)), 0.0, 1.0),
        lambda bad: SurfaceFields(BODY, (8, 8), PITCH, "p_n", 1e-3)(bad(IMAGES)),
        lambda bad: SURFACE.displacement_m(bad(IMAGES)),
        lambda bad: FrictionalContact(SURFACE, bad(BOWL), 0.5),
        lambda bad: FrictionalContact(SURFACE, BOWL, 0.5).step(
            FrictionalContact(SURFACE, BOWL, 0.5).apart, load_newton=bad(np.ones(3))
        ),
        lambda bad: solve_regions(SURFACE, bad(IMAGES), np.full((3, 8, 8), np.nan)),
        lambda bad: MIXED.field(bad(IMAGES), "p_n"),
    ],
)
@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (lambda array: array + 1j, "holds complex128, must hold real numbers"),
        (lambda array: array.astype(str), "must hold real numbers"),
        (lambda array: [[1.0], [1.0, 2.0]], "rows differ in length"),
    ],
)
def test_what_holds_no_real_numbers_is_refused(ask: Callable, bad: Callable, complaint: str):
    with pytest.raises(ValueError, match=complaint):
        ask(bad)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"have shapes \(2,\), \(3,\), \(\), which must broadcast"):
        BODY.transfer_matrix("p_n", "traction", [1.0, 2.0], [1.0, 2.0, 3.0], 0.0)
    for shape in ((4.5, 4), (4.0, 4.0), 4, (4,), (np.nan, 4)):
        with pytest.raises(ValueError, match=r"must be a tuple .* of whole numbers"):
            SpectralGrid(shape, 1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must hold at least one depth"):
        SurfaceFields(BODY, (8, 8), PITCH, "p_n", [])
    with pytest.raises(ValueError, match=r"poisson_ratio has shape \(1,\), must be one number"):
        HalfSpace(2e5, np.array([0.3]))  # type: ignore[arg-type]


@pytest.mark.parametrize("load", [1e-9, 1e-12, 1e-15, 1e-20, 1e160, 1e300])
def test_a_load_is_kept_or_said_to_be_out_of_reach(load: float):
    try:
        with np.errstate(all="ignore"):
            found = BODY_ON_BOWL.step(BODY_ON_BOWL.apart, load_newton=(0.0, 0.0, load))
    except (NotConvergedError, ValueError) as error:
        assert str(error)  # noqa: PT017
    else:
        assert found.load_newton[2] == pytest.approx(load, rel=1e-7)
