"""Slip: margins of single frames, of frames that follow each other, and events; the truth comes from closed forms."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, TO_TRIPLE, Contact, E, noise_std, noisy, summed_points

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction, PartialSlip, stick_ratio
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipEvent, SlipFitter, SlipWatch, fit_partial_slip
from simulators.contact import pressed_signals

PRESSED = Contact((3e-4, -1.1e-3), 2.4e-3, 0.6, 0.8)

CENTRE_M, RADIUS_M, MU = (-6e-4, 9e-4), 2.4e-3, 0.6
START = ContactStart((-3e-4, 7e-4), 2.1e-3)


def about(scene: Contact, friction: Friction | None = None) -> ContactStart:
    x, y = scene.centre_m
    return ContactStart((x + 4e-4, y - 3e-4), 1.2 * scene.radius_m, friction=friction)


def one(discs: DiscModel, signals: Floats, noise: float, scene: Contact, friction: Friction | None) -> PartialSlip:
    return fit_partial_slip(discs, signals, noise, [about(scene, friction)])[0]


@pytest.mark.parametrize("friction", [None, Friction(0.5), Friction(0.5, 0.02)])
@pytest.mark.parametrize("ratio", [0.02, 0.3, 0.6, 0.9])
def test_recovers_a_frame_without_noise(discs: DiscModel, friction: Friction | None, ratio: float) -> None:
    scene = replace(PRESSED, stick_ratio=ratio)
    found = one(discs, scene.signals, noise_std(scene.signals, 60.0), scene, friction)
    assert (found.status, found.reason) == ("ok", None)
    np.testing.assert_allclose(found.centre_m, scene.centre_m, atol=1e-6)
    np.testing.assert_allclose(found.radius_m, scene.radius_m, rtol=1e-3)
    np.testing.assert_allclose(found.force_newton, scene.force_newton, atol=1e-3)
    np.testing.assert_allclose(found.slip_margin, ratio**3, atol=3e-3)
    np.testing.assert_allclose(found.friction_coefficient, 0.5, rtol=1e-2)


@pytest.mark.parametrize(
    ("friction", "decibel", "limit"), [(Friction(0.5), 11.0, 0.03), (Friction(0.5), 30.0, 0.005), (None, 20.0, 0.025)]
)
def test_noisy_frames_with_honest_errors(
    discs: DiscModel, friction: Friction | None, decibel: float, limit: float
) -> None:
    rng = np.random.default_rng(1)
    ratios, scores, radii = [], [], []
    for _ in range(24):
        scene = Contact.random(rng)
        found = one(discs, noisy(scene.signals, decibel, rng), noise_std(scene.signals, decibel), scene, friction)
        ratios.append(found.stick_ratio - scene.stick_ratio)
        radii.append(found.radius_m / scene.radius_m - 1.0)
        truth = np.array([*scene.centre_m, scene.radius_m, *scene.force_newton, scene.stick_ratio**3])
        estimate = np.array([*found.centre_m, found.radius_m, *found.force_newton, found.slip_margin])
        scores.append((estimate - truth) / np.sqrt(np.diag(found.covariance)))
    assert np.sqrt(np.mean(np.square(ratios))) <= limit
    assert np.sqrt(np.mean(np.square(radii))) <= 0.01
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert ((rms > 0.6) & (rms < 1.5)).all()


def test_gross_slip_beyond_the_friction_given_is_seen(discs: DiscModel) -> None:
    scene = replace(PRESSED, stick_ratio=0.0, mu=0.3)
    found = one(discs, scene.signals, noise_std(scene.signals, 30.0), scene, Friction(0.5, 0.05))
    assert found.slip_margin < 0.02
    assert found.friction_coefficient == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("decibel", [11.0, 20.0, 30.0])
def test_without_shear_the_margin_is_unknown_and_the_pose_is_not(discs: DiscModel, decibel: float) -> None:
    scene = replace(PRESSED, stick_ratio=1.0)
    rng = np.random.default_rng(5)
    for _ in range(6):
        found = one(discs, noisy(scene.signals, decibel, rng), noise_std(scene.signals, decibel), scene, None)
        assert found.status == "unknown"
        assert np.isnan([found.slip_margin, found.stick_ratio, found.friction_coefficient]).all()
        assert found.radius_m == pytest.approx(scene.radius_m, rel=0.03)


def test_another_shape_is_unknown(discs: DiscModel) -> None:
    flat = summed_points(np.zeros(2), 2.5e-3 * np.eye(2), -0.5)
    signals = flat[2] + 0.2 * flat[0]
    found = fit_partial_slip(discs, signals, noise_std(signals, 30.0), [ContactStart((2e-4, 0.0), 2e-3)])[0]
    assert found.status == "unknown"
    assert np.isnan([*found.force_newton, found.radius_m, found.slip_margin]).all()


@pytest.mark.parametrize("factor", [np.nan, 1e6])
def test_a_frame_out_of_all_bounds_is_unknown(discs: DiscModel, factor: float) -> None:
    found = fit_partial_slip(discs, factor * (PRESSED.signals + 1e-4), 1e-4, [about(PRESSED)])[0]
    assert found.status == "unknown"
    assert np.isnan(found.force_newton).all()


def test_stick_ratio_near_gross_slip_has_a_wide_error() -> None:
    assert stick_ratio(0.125, 0.0) == (0.5, 0.0)
    ratio, std = stick_ratio(0.0, 0.008)
    assert ratio == 0.0
    assert std == pytest.approx(0.1)


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


def sheared(share: Floats) -> Floats:
    """Forces (t, 3) at shares of the largest shear that friction bears."""
    along = np.array([0.6, 0.8])
    return np.column_stack([MU * share[:, None] * along, np.ones_like(share)])


def follow(watch: SlipWatch, share: Floats, seed: int) -> tuple[list[tuple[int, SlipEvent]], Floats, Floats]:
    """Events with the index of their frame; margins and their standard deviations."""
    rng = np.random.default_rng(seed)
    skin = (SITES_M, DEPTH_M, E, NU, CENTRE_M, RADIUS_M, MU)
    frames = np.stack([pressed_signals(*skin, force) * TO_TRIPLE for force in sheared(share)])
    noise = noise_std(frames[0], 20.0)
    events, margins = [], []
    for index, frame in enumerate(frames):
        fits = watch.update(frame + noise * rng.standard_normal(frame.shape), noise, {4: START})
        events += [(index, event) for event in watch.announce(fits)]
        margins.append((fits[4].slip_margin, fits[4].slip_margin_std))
    return events, *np.array(margins).T


@pytest.mark.parametrize("friction", [None, Friction(MU, 0.05)])
@pytest.mark.parametrize("frames", [40, 110])
def test_ramp_to_gross_slip(discs: DiscModel, friction: Friction | None, frames: int) -> None:
    share = np.linspace(0.0, 1.2, frames)
    events, margins, std = follow(SlipWatch(discs, friction), share, frames)
    assert [event.event for _, event in events] == ["incipient_slip", "gross_slip"]
    assert [event.contact for _, event in events] == [4, 4]
    gross = int(np.argmax(share >= 1.0))
    (incipient, _), (slipping, last) = events
    assert share[incipient] > 0.65
    assert incipient < gross
    assert abs(slipping - gross) <= 0.1 * frames
    assert last.slip.friction_coefficient == pytest.approx(MU, rel=0.05)
    known = np.isfinite(margins)
    assert known[share > 0.4].all()
    scores = (margins - np.maximum(1.0 - share, 0.0))[known] / std[known]
    assert 0.4 < np.sqrt(np.mean(scores**2)) < 1.7
    assert known.all() == (friction is not None)


def test_announces_again_after_recovery(discs: DiscModel) -> None:
    down, up = np.full(6, 0.85), np.full(6, 0.4)
    events, *_ = follow(SlipWatch(discs, Friction(MU, 0.03)), np.concatenate([up, down, down, up, down]), 4)
    assert [(index, event.event) for index, event in events] == [(7, "incipient_slip"), (25, "incipient_slip")]
    events, *_ = follow(SlipWatch(discs, Friction(MU, 0.03)), np.full(3, 0.85), 4)  # low from its first frame on
    assert [index for index, _ in events] == [1]


def test_a_contact_that_is_gone_is_forgotten(discs: DiscModel) -> None:
    watch = SlipWatch(discs)
    follow(watch, np.linspace(0.3, 0.9, 12), 5)
    assert watch.update(np.zeros((3, len(SITES_M))), 1e-6, {}) == {}
    _, margins, _ = follow(watch, np.zeros(3), 6)
    assert np.isnan(margins).all()


def test_an_unknown_frame_does_not_end_it(discs: DiscModel) -> None:
    watch = SlipWatch(discs, Friction(MU, 0.03))
    follow(watch, np.full(3, 0.5), 7)
    fits = watch.update(np.random.default_rng(0).standard_normal((3, len(SITES_M))), 1.0, {4: START})
    assert fits[4].status == "unknown"
    assert watch.announce(fits) == ()
    _, margins, _ = follow(watch, np.full(3, 0.5), 8)
    np.testing.assert_allclose(margins, 0.5, atol=0.1)
