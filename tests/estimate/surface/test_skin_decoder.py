"""The decoder of one skin: which one it is, what counts as lost, which noise it is built for, and what it passes on."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from contact_scenes import DEPTH_M, FRICTION, NU, PITCH_M, E
from contact_scenes import grid_positions as grid
from skin_scenes import SITES_M, noisy, press
from skin_scenes import SKIN as SKIN_LONG

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.skin import DecodingOptions, Prior, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise

SHAPE, SITES = (12, 12), 144
HALF_SPACE = HalfSpace(E, NU)
SKIN = Skin(HALF_SPACE, grid(SHAPE), DEPTH_M)
SCATTERED = replace(SKIN, site_positions_m=grid(SHAPE) + np.random.default_rng(0).uniform(-1e-4, 1e-4, (SITES, 2)))
# Powers of two, which rounding keeps.
NOISE = np.tile([[2.0**-7], [2.0**-8], [2.0**-8]], SITES)
QUIET = np.full((3, len(SITES_M)), 2.0**-8)
LINEAR, PHYSICS, FOURIER = DecodingOptions(contact_physics=False), DecodingOptions(), DecodingOptions("fourier")


def build(skin: Skin, options: DecodingOptions) -> SkinDecoder:
    return SkinDecoder(skin, options, NOISE, [].append)


@pytest.fixture(scope="module")
def linear() -> SkinDecoder:
    return build(SKIN, LINEAR)


@pytest.fixture(scope="module")
def physics_built() -> SkinDecoder:
    return build(SKIN, PHYSICS)


@pytest.fixture
def physics(physics_built: SkinDecoder) -> SkinDecoder:
    """Nothing is left of the test before."""
    physics_built.reset("test")
    return physics_built


def frame(seed: int = 0, skin: Skin = SKIN) -> Floats:
    signals = press(sites_m=skin.site_positions_m, shear_newton=(0.3, 0.0))
    return noisy(signals, np.random.default_rng(seed), NOISE)


@pytest.mark.parametrize(
    ("skin", "options", "expected"),
    [
        (SKIN, LINEAR, ("open-plane", SHAPE)),
        (SKIN, PHYSICS, ("open-plane+contact", SHAPE)),
        (SKIN, FOURIER, ("fourier", SHAPE)),  # contact physics needs the other one
        (SCATTERED, PHYSICS, ("open-plane+contact", (SITES,))),
    ],
)
def test_name_and_shape(skin: Skin, options: DecodingOptions, expected: tuple[str, tuple[int, ...]]) -> None:
    decoder = build(skin, options)
    assert (decoder.name, decoder.shape) == expected


@pytest.mark.parametrize("options", [LINEAR, FOURIER], ids=["open-plane", "fourier"])
def test_gain_errors_and_prior_of_the_skin_reach_the_decoder(options: DecodingOptions) -> None:
    skin = replace(SKIN, gain_std=0.05, prior=Prior(0.7e-3, 0.8))
    expected: OpenPlaneDecoder | FourierDecoder
    if options is LINEAR:
        expected = OpenPlaneDecoder(
            HALF_SPACE, skin.site_positions_m, DEPTH_M, NOISE, gain_std=skin.gain_std, prior=skin.prior
        )
    else:
        expected = FourierDecoder(HALF_SPACE, SHAPE, PITCH_M, DEPTH_M, NOISE.reshape(3, *SHAPE), prior=skin.prior)
    decoded = build(skin, options).decode(frame(), NOISE).decoded
    direct = expected.decode(frame().reshape(3, *SHAPE), displacement=True)
    for name in ("traction_pascal", "traction_std_pascal", "displacement_m"):
        found, known = getattr(decoded, name), getattr(direct, name)
        np.testing.assert_allclose(found, known, rtol=1e-5, atol=1e-6 * np.abs(known).max())


@pytest.mark.parametrize("noise", [3.1, np.nan, np.inf], ids=["3.1 times the usual", "unknown", "infinite"])
def test_a_signal_far_noisier_than_usual_counts_as_lost(linear: SkinDecoder, noise: float) -> None:
    signals, noise_std = frame(), NOISE.copy()
    noise_std[1, 70] *= noise
    noise_std[2, :] *= 1.4  # still of use
    signals[1, 70] = 1.0  # nonsense, as such a noise allows
    lost = linear.decode(signals, noise_std).decoded
    assert lost.reason.startswith("1 of 432 signals lost")
    expected = signals.copy()
    expected[1, 70] = np.nan
    np.testing.assert_array_equal(lost.traction_pascal, linear.decode(expected, NOISE).decoded.traction_pascal)
    noise_std[1, 70] = 2.9 * NOISE[1, 70]
    assert linear.decode(signals, noise_std).decoded.reason == ""


@pytest.mark.parametrize(
    ("factors", "fits"),
    [
        ((1.0, 1.0, 1.0), True),
        ((1.45, 0.7, 1.0), True),
        ((1.0, 1.0, 1.55), False),
        ((1.0, 0.64, 1.0), False),
        ((np.nan, 1.2, 1.0), True),  # nothing is heard of it: a frame to flag, no reason to build anew
        ((np.inf, 1.0, 1.0), True),
        ((np.nan, np.nan, np.nan), True),
        ((np.nan, 1.0, 2.0), False),
    ],
)
def test_it_fits_until_a_channels_noise_has_changed(
    linear: SkinDecoder, factors: tuple[float, ...], fits: bool
) -> None:
    noise_std = NOISE * np.array(factors)[:, None]
    noise_std[:, :60] = np.nan
    noise_std[:, 60:70] *= 100.0  # less than half of those that are known
    assert linear.fits(noise_std) == fits


def test_noise_to_build_for_is_the_median_on_a_grid_and_each_signals_own_elsewhere() -> None:
    small = replace(SKIN, site_positions_m=grid((2, 2)))
    # Medians of what is known in each channel, by hand: 2 of 1 2 5, 4 of 4 4 8, and 8 between 4 and 12.
    noise_std = np.array([[1.0, 5.0, 2.0, np.nan], [4.0, 4.0, np.inf, 8.0], [0.0, 4.0, 12.0, -1.0]])
    np.testing.assert_allclose(rounded_noise(small, noise_std), np.tile([[2.0], [4.0], [8.0]], 4), rtol=1e-12)
    scattered = replace(small, site_positions_m=np.array([[0.0, 0.0], [1.0, 0.1], [0.2, 1.0], [1.3, 1.2]]) * 1e-3)
    expected = [[1.0, 5.0, 2.0, 2.0], [4.0, 4.0, 4.0, 8.0], [8.0, 4.0, 12.0, 8.0]]  # each its own, else the median
    np.testing.assert_allclose(rounded_noise(scattered, noise_std), expected, rtol=0.011)
    noise_std[1] = np.inf
    assert rounded_noise(small, noise_std) is None


def test_noise_is_rounded_finely_and_the_same_for_what_hardly_differs() -> None:
    random = np.random.default_rng(3)
    noise_std = np.exp(random.uniform(-9.0, -1.0, (3, SITES)))
    rounded = rounded_noise(SCATTERED, noise_std)
    assert rounded is not None
    ratio = rounded / noise_std
    assert 0.5 * (2.0 ** (1 / 64) - 1.0) < np.abs(ratio - 1.0).max() <= 2.0 ** (1 / 64) - 1.0
    np.testing.assert_array_equal(rounded_noise(SCATTERED, rounded * random.uniform(0.995, 1.005, (3, SITES))), rounded)


def test_friction_that_is_configured_bounds_shear() -> None:
    """A sliding contact contradicts a coefficient of a fifth of its own; its own it does not."""
    sliding = press(sites_m=SKIN.site_positions_m, shear_newton=(FRICTION, 0.0))
    status = {}
    for friction in (FRICTION, FRICTION / 5.0):
        decoder = build(SKIN, DecodingOptions(friction_coefficient=friction))
        for seed in range(3):
            decoded = decoder.decode(noisy(sliding, np.random.default_rng(seed), NOISE), NOISE).decoded
            decoder.rebuild()
        status[friction] = str(decoded.status)
    assert status == {FRICTION: "ok", FRICTION / 5.0: "constraint_dropped"}


def test_frames_give_contacts_and_a_new_start_ends_them(physics: SkinDecoder) -> None:
    readings = []
    for seed in range(3):
        readings.append(physics.decode(frame(seed), NOISE))
        physics.rebuild()
    assert [[event.event for event in reading.events] for reading in readings] == [[], ["onset"], []]
    (contact,) = readings[2].contacts
    np.testing.assert_allclose(contact.patch.force_newton, [0.3, 0.0, 1.0], atol=0.03)
    assert physics.decode(np.full((3, SITES), np.nan), NOISE).decoded.status == "no_signal"
    (event,) = physics.reset("unplugged")
    assert (event.event, event.contact, event.reason) == ("release", contact, "unplugged")
    assert physics.reset("test") == ()
    assert physics.decode(frame(), NOISE).contacts == ()


def test_a_successor_goes_on_counting_and_reports_how_contacts_end(linear: SkinDecoder, physics: SkinDecoder) -> None:
    for seed in range(2):
        (*_, last) = physics.decode(frame(seed), NOISE).contacts or [None]
    assert last is not None
    successor = pickle.loads(pickle.dumps(linear))
    successor.reset("test")
    (event,) = successor.succeed(physics)
    assert (event.event, event.contact.id, bool(event.reason)) == ("release", last.id, True)
    for seed in range(2):
        contacts = successor.decode(frame(seed), NOISE).contacts
    assert [contact.id for contact in contacts] == [last.id + 1]


@pytest.mark.parametrize(("side", "pitch", "said"), [(6, 1.0, "36 sites"), (7, 8.0, "3.2 mm apart")])
def test_sites_too_few_or_too_far_apart_for_a_map_are_refused(side: int, pitch: float, said: str) -> None:
    skin = replace(SKIN, site_positions_m=pitch * grid((side, side)))
    with pytest.raises(ValueError, match=said):
        SkinDecoder(skin, PHYSICS, np.full((3, side * side), 2.0**-12), [].append)


def settled(decoder: SkinDecoder, signals: Floats) -> SurfaceReading:
    """What the decoder makes of a steady load once its matrices are there."""
    random = np.random.default_rng(3)
    decoder.reset("test")
    for _ in range(6):
        reading = decoder.decode(noisy(signals, random, QUIET), QUIET)
        while decoder.rebuild():
            pass
    return reading


@pytest.fixture(scope="module")
def long() -> SkinDecoder:
    return SkinDecoder(SKIN_LONG, PHYSICS, QUIET, [].append)


def test_contacts_on_one_support_share_its_load(long: SkinDecoder) -> None:
    loads = (1.0, (-1.4e-3, 0.2e-3)), (0.4, (1.4e-3, 0.2e-3))  # rims 0.7 mm apart
    first, second = settled(long, press(*loads[0]) + press(*loads[1])).contacts
    for contact, (force_newton, centre_m) in zip((first, second), loads, strict=True):
        assert contact.patch.force_newton[2] == pytest.approx(force_newton, rel=0.02)
        np.testing.assert_allclose(contact.patch.centroid_m, centre_m, atol=4e-5)


def test_at_the_border_error_bars_state_how_little_is_known(long: SkinDecoder) -> None:
    edge_m = float(SITES_M[:, 0].max())
    (contact,) = settled(long, press(1.0, (edge_m - 2e-4, 0.0))).contacts
    patch = contact.patch
    assert patch.at_border
    assert patch.force_std_newton[2] >= 0.03 * patch.force_newton[2]
    assert patch.force_newton[2] == pytest.approx(1.0, abs=3.0 * patch.force_std_newton[2])
    assert patch.centroid_m[0] == pytest.approx(edge_m - 2e-4, abs=3.0 * patch.centroid_std_m[0])
