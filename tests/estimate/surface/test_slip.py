"""Slip over time: announced before it is gross, never under a safe load, friction learned on the way."""

import numpy as np
import pytest
from contact_scenes import DEPTH_M, NU, SITES_M, TO_TRIPLE, E, disc_model, noise_std

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipEvent, SlipWatch
from simulators.contact import pressed_signals

CENTRE_M, RADIUS_M, MU = (-6e-4, 9e-4), 2.4e-3, 0.6
START = ContactStart((-3e-4, 7e-4), 2.1e-3)


@pytest.fixture(scope="module")
def discs() -> DiscModel:
    return disc_model()


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
        fits, news = watch.update(frame + noise * rng.standard_normal(frame.shape), noise, {4: START})
        events += [(index, event) for event in news]
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
    assert watch.update(np.zeros((3, len(SITES_M))), 1e-6, {}) == ({}, ())
    _, margins, _ = follow(watch, np.zeros(3), 6)
    assert np.isnan(margins).all()


def test_an_unknown_frame_does_not_end_it(discs: DiscModel) -> None:
    watch = SlipWatch(discs, Friction(MU, 0.03))
    follow(watch, np.full(3, 0.5), 7)
    fits, events = watch.update(np.random.default_rng(0).standard_normal((3, len(SITES_M))), 1.0, {4: START})
    assert fits[4].status == "unknown"
    assert events == ()
    _, margins, _ = follow(watch, np.full(3, 0.5), 8)
    np.testing.assert_allclose(margins, 0.5, atol=0.1)
