"""Contacts over time on a small skin: onset, release, forces, curvature and slip against the loads they come from."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
from contact_scenes import DEPTH_M, FRICTION, NU, E
from skin_scenes import NOISE, RADIUS_M, SITES, SITES_M, SKIN, noisy, press

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.layout import cell_areas_m2
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.patches import PatchFinder
from resonator_daemon.estimate.surface.skin import Skin
from resonator_daemon.estimate.surface.skin_contacts import SkinContact, SkinContacts, SkinEvent
from resonator_daemon.estimate.surface.skin_decoder import net_patches

FINDER = PatchFinder(SITES_M, cell_areas_m2(SITES_M), DEPTH_M)
NOTHING = np.zeros((3, SITES))
CURVATURE_M = 4.0 * RADIUS_M**3 * E / (3.0 * (1.0 - NU**2))  # that gives RADIUS_M at a newton, by Hertz


class Rig(NamedTuple):
    """Decoders of the small skin, which take some time to set up."""

    linear: OpenPlaneDecoder
    physics: ContactDecoder
    contacts: SkinContacts


@pytest.fixture(scope="module")
def built() -> Rig:
    linear = OpenPlaneDecoder(SKIN.half_space, SITES_M, DEPTH_M, NOISE)
    return Rig(linear, ContactDecoder(linear), SkinContacts(SKIN, NOISE, None))


@pytest.fixture
def rig(built: Rig) -> Rig:
    """Nothing is left of the test before but the ids that were given."""
    built.contacts.reset("test")
    built.physics.reset()
    built.contacts.friction_estimate = None
    return built


class Followed(NamedTuple):
    contacts: tuple[SkinContact, ...]
    events: tuple[SkinEvent, ...]


def follow(rig: Rig, frames: Iterable[Floats], *, physics: bool = True, seed: int = 1) -> list[Followed]:
    """What each frame, noise added, shows."""
    random, followed = np.random.default_rng(seed), []
    for frame in frames:
        signals = noisy(frame, random)
        decoded = (rig.physics if physics else rig.linear).decode(signals)
        if physics:
            patches = net_patches(FINDER, rig.physics, decoded)
        else:
            patches = FINDER.find(decoded.traction_pascal, decoded.traction_std_pascal)
        followed.append(Followed(*rig.contacts.update(signals, patches)))
    return followed


def told(followed: list[Followed]) -> list[tuple[int, str]]:
    return [(number, event.event) for number, frame in enumerate(followed) for event in frame.events]


@pytest.mark.parametrize("physics", [True, False], ids=["contact physics", "linear"])
def test_a_press_sets_on_at_its_second_frame_and_is_released_once(rig: Rig, physics: bool) -> None:
    followed = follow(rig, [NOTHING] * 5 + [press(0.3)] * 8 + [NOTHING] * 8, physics=physics)
    events = told(followed)
    assert [event for _, event in events] == ["onset", "release"]
    assert [bool(event.reason) for frame in followed for event in frame.events] == [False, True]
    assert events[0][0] == 6
    assert 13 < events[1][0] <= 16
    assert [len(frame.contacts) for frame in followed[6:13]] == [1] * 7
    (ids,) = {frozenset(contact.id for contact in frame.contacts) for frame in followed[6:13]}
    assert {event.contact.id for frame in followed for event in frame.events} == ids
    assert all(not frame.contacts for frame in followed[:6] + followed[13:])


@pytest.mark.parametrize("frames", [[1, 0, 0, 0], [1, 0, 1, 0, 1, 0]], ids=["once", "every other"])
def test_what_lasts_a_single_frame_is_no_contact(rig: Rig, frames: list[int]) -> None:
    followed = follow(rig, [press() if pressed else NOTHING for pressed in frames * 3])
    assert told(followed) == []
    assert not any(frame.contacts for frame in followed)


@pytest.mark.parametrize(("significance", "expected"), [(5.0, []), (7.0, ["onset"])])
def test_a_patch_is_a_contact_from_six_standard_deviations_of_its_force(
    rig: Rig, significance: float, expected: list[str]
) -> None:
    traction, std = np.zeros((3, SITES)), np.ones((3, SITES))
    traction[2, [SITES // 2, SITES // 2 + 1]] = 1e3
    (patch,) = FINDER.find(traction, std)
    std *= patch.force_newton[2] / patch.force_std_newton[2] / significance
    patches = FINDER.find(traction, std)
    events = [event for _ in range(3) for event in rig.contacts.update(NOTHING, patches)[1]]
    assert [event.event for event in events] == expected


def test_two_contacts_at_once(rig: Rig) -> None:
    centres_mm, forces = ((-2.3, 0.2), (2.3, -0.3)), (1.0, 0.5)
    both = sum(press(force, (x * 1e-3, y * 1e-3)) for (x, y), force in zip(centres_mm, forces, strict=True))
    assert isinstance(both, np.ndarray)
    followed = follow(rig, [both] * 4 + [press(0.5, (2.3e-3, -0.3e-3))] * 4)
    assert told(followed) == [(1, "onset"), (1, "onset"), (6, "release")]
    for contact, (x, y), force in zip(followed[3].contacts, centres_mm, forces, strict=True):
        np.testing.assert_allclose(contact.patch.force_newton, [0.0, 0.0, force], atol=0.02 * force)
        np.testing.assert_allclose(contact.patch.centroid_m, [x * 1e-3, y * 1e-3], atol=5e-5)
        assert contact.radius_of_curvature_m == pytest.approx(CURVATURE_M, rel=0.03)
    first, second = followed[3].contacts
    assert first.id != second.id
    assert followed[6].events[0].contact.id == first.id
    assert [contact.id for contact in followed[-1].contacts] == [second.id]


def test_the_peak_is_that_of_the_contacts_life(rig: Rig) -> None:
    loads = [0.3] * 3 + [1.0] * 3 + [0.4] * 3
    followed = follow(rig, [press(load) for load in loads] + [NOTHING] * 4)
    first, last = followed[2].contacts[0], followed[8].contacts[0]
    assert first.peak_newton == pytest.approx(0.3, rel=0.05)
    assert last.patch.force_newton[2] == pytest.approx(0.4, rel=0.05)
    assert last.peak_newton == pytest.approx(1.0, rel=0.03)
    (release,) = [event for frame in followed for event in frame.events if event.event == "release"]
    assert release.contact.peak_newton == last.peak_newton


def ramp(frames: int = 40, hold: int = 6) -> list[Floats]:
    """A press of 1 N whose shear grows until it slides; the margin falls below 0.3 at 72 %, and to 0 at the end."""
    shears = np.append(np.linspace(0.0, FRICTION, frames), [FRICTION] * hold)
    return [press(1.0, shear_newton=(0.6 * shear, 0.8 * shear)) for shear in shears]


def test_friction_that_slip_has_taught_is_kept(rig: Rig) -> None:
    follow(rig, ramp()[:10])
    assert rig.contacts.friction_estimate is None  # 0.1 N of shear: nothing slips that could tell
    follow(rig, ramp()[10:])
    assert rig.contacts.friction_estimate == pytest.approx(FRICTION, rel=0.05)
    follow(rig, [NOTHING] * 4)
    assert rig.contacts.friction_estimate == pytest.approx(FRICTION, rel=0.05)  # kept beyond the contact


@pytest.mark.parametrize("missing", [1, 2, 3])
def test_a_contact_outlives_two_frames_that_show_nothing(rig: Rig, missing: int) -> None:
    followed = follow(rig, [press()] * 3 + [np.full((3, SITES), np.nan)] * missing + [press()] * 3)
    assert not any(frame.contacts for frame in followed[3 : 3 + missing])
    events = [event for _, event in told(followed)]
    assert events == (["onset"] if missing < 3 else ["onset", "release", "onset"])


def gain_errors(linear: OpenPlaneDecoder, skin: Skin, *, glitch: bool = False) -> SkinContact:
    """The contact of a press whose signals have gains that are off by 10 % rms."""
    random = np.random.default_rng(5)
    contacts = SkinContacts(skin, NOISE, None)
    for _ in range(3):
        signals = noisy(press() * (1.0 + 0.1 * random.standard_normal((3, SITES))), random)
        if glitch:
            signals[1, 5] = 1e6
        decoded = linear.decode(signals)
        followed, _ = contacts.update(signals, FINDER.find(decoded.traction_pascal, decoded.traction_std_pascal))
    return followed[0]


def test_gain_errors_count_as_noise_of_the_fit(rig: Rig) -> None:
    skin = Skin(SKIN.half_space, SITES_M, DEPTH_M, gain_std=0.1)
    deaf, warned = gain_errors(rig.linear, SKIN), gain_errors(rig.linear, skin)
    hit = gain_errors(rig.linear, skin, glitch=True)
    assert deaf.slip is not None
    assert warned.slip is not None
    assert hit.slip is not None
    assert deaf.slip.chi2 > 3.0
    assert 0.5 < warned.slip.chi2 < 1.6
    assert hit.slip.radius_std_m == pytest.approx(warned.slip.radius_std_m, rel=0.1)  # a lost signal is no rms
