"""Fits that begin where the frame before ended, against fits of each frame from its patch alone."""

from collections.abc import Iterable

import numpy as np
import pytest
from contact_scenes import Contact, disc_model, noise_std

from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction, PartialSlip
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipFitter, fit_partial_slip


@pytest.fixture(scope="module")
def discs() -> DiscModel:
    return disc_model()


def sliding(frames: int = 8, step_m: float = 4e-5) -> list[list[Contact]]:
    ratios = 0.5 + 0.2 * np.sin(np.arange(frames) / 3.0)
    return [[Contact((step_m * i, 5e-4), 2.2e-3, ratio, 0.4)] for i, ratio in enumerate(ratios)]


def two(frames: int = 5) -> list[list[Contact]]:
    return [
        [Contact((-3.4e-3 + 3e-5 * i, 1e-3), 1.8e-3, 0.5, 0.3), Contact((3e-3, -1e-3), 1.9e-3, 0.6, 2.0, 0.8, 0.7)]
        for i in range(frames)
    ]


def growing(frames: int = 7) -> list[list[Contact]]:
    """Press whose force grows by half from frame to frame."""
    forces = 0.1 * 1.5 ** np.arange(frames)
    return [[Contact((0.0, 0.0), 1.5e-3 * np.cbrt(10 * f), 0.6, 0.4, normal_newton=float(f))] for f in forces]


def start(scene: Contact, friction: Friction | None) -> ContactStart:
    x, y = scene.centre_m
    return ContactStart((x + 1e-4, y - 1e-4), 1.1 * scene.radius_m, friction=friction)


def assert_alike(found: Iterable[PartialSlip], expected: Iterable[PartialSlip]) -> None:
    """Estimates that differ by a quarter of a standard deviation, error bars by a tenth, at most."""
    for one, other in zip(found, expected, strict=True):
        assert (one.status, one.reason) == (other.status, other.reason)
        std = np.sqrt(np.diag(other.covariance))
        np.testing.assert_allclose(np.sqrt(np.diag(one.covariance)), std, rtol=0.1)
        estimates = [
            np.array([*slip.centre_m, slip.radius_m, *slip.force_newton, slip.slip_margin]) for slip in (one, other)
        ]
        off = np.abs(estimates[0] - estimates[1]) / std
        assert off[np.isfinite(off)].max() < 0.25
        assert one.chi2 == pytest.approx(other.chi2, rel=1e-3)


@pytest.mark.parametrize("friction", [None, Friction(0.5, 0.02)], ids=["mu unknown", "mu known"])
@pytest.mark.parametrize("lost", [0.0, 0.05], ids=["whole", "signals lost"])
@pytest.mark.parametrize("scenes", [sliding(), two(), growing()], ids=["sliding", "two", "growing"])
def test_following_is_as_good_as_fits_of_single_frames(
    discs: DiscModel, scenes: list[list[Contact]], lost: float, friction: Friction | None
) -> None:
    rng, fitter = np.random.default_rng(0), SlipFitter(discs)
    noise = np.full((3, 1024), noise_std(scenes[0][0].signals, 25.0))
    for contacts in scenes:
        signals = np.sum([scene.signals for scene in contacts], axis=0) + noise * rng.standard_normal(noise.shape)
        signals[rng.random(signals.shape) < lost] = np.nan
        starts = {7 + i: start(scene, friction if i == 0 else None) for i, scene in enumerate(contacts)}
        found = fitter.fit(signals, noise, starts)
        assert list(found) == list(starts)
        assert_alike(found.values(), fit_partial_slip(discs, signals, noise, list(starts.values())))
