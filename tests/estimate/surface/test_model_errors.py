"""Contacts on a skin that is not as it is stated: what contradicts the model, and what the stated errors cover."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contact_scenes import DEPTH_M, FRICTION, E
from skin_scenes import NOISE, RADIUS_M, SITES_M, SKIN, noisy

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.fitting.fit_check import RestScatter
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_contacts import SkinContact
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

FORCE_NEWTON, CENTRE_M = (0.15, -0.1, 1.0), (3e-4, -2e-4)
MARGIN = 1.0 - np.hypot(0.15, 0.1) / FRICTION
OFF = 0.05
SITE = int(np.hypot(*(SITES_M - CENTRE_M).T).argmin())


def signals(depth: float = 1, modulus: float = 1, gain: float = 1, position_m: float = 0, common: float = 0) -> Floats:
    """Return signals of one press on a skin that is off by these factors, its sites by so much, all by their noise."""
    sites_m = SITES_M + position_m * np.random.default_rng(2).standard_normal(SITES_M.shape)
    radii, forces = hertz_parts(FORCE_NEWTON, RADIUS_M, FRICTION)
    fields = hertz_fields(sites_m - CENTRE_M, depth * DEPTH_M, radii, modulus * E, 0.5)
    strains = np.einsum("kf,kfsn->sn", forces, fields) * np.array([[1.5 / E], [1.0], [1.0]])
    return np.asarray(gain * strains + common * NOISE)


@pytest.fixture(scope="module")
def decoder() -> SkinDecoder:
    return decoder_of(SKIN)


def decoder_of(skin: Skin) -> SkinDecoder:
    return SkinDecoder(skin, DecodingOptions(background=False), NOISE, lambda _: None)


def pressed(decoder: SkinDecoder, clean: Floats, *, noise: float = 1.0, frames: int = 12) -> SkinContact:
    """Return the contact in the last of some frames, after some at rest."""
    rng = np.random.default_rng(1)
    decoder.reset(Reason(ReasonCode.DECODER_RESET, "of a test"))
    decoder.start_cold()
    for frame in [np.zeros_like(clean)] * 60 + [clean] * frames:
        reading = decoder.decode(noisy(frame, rng, noise * NOISE), noise * NOISE)
    (contact,) = reading.contacts
    return contact


@pytest.mark.parametrize(("noise", "common"), [(1.0, 0.0), (1.3, 0.0), (1.0, 3.0)])
def test_the_chi_square_of_a_right_model_is_one_at_every_noise_and_common_mode(noise: float, common: float) -> None:
    contact = pressed(decoder := decoder_of(SKIN), signals(common=common), noise=noise)
    assert decoder.contacts.offset == pytest.approx(np.full(3, common), abs=0.2)
    assert contact.fit is not None
    assert contact.fit.degrees_of_freedom == 3 * len(SITES_M) - 7
    assert contact.fit.chi2 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / contact.fit.degrees_of_freedom))
    assert (contact.status, contact.reason) == ("ok", None)


def test_neither_noisy_sites_nor_a_frame_of_zeros_move_the_scatter_at_rest() -> None:
    scatter, rng = RestScatter(), np.random.default_rng(4)
    scatter.add(np.zeros((3, 1024)))
    for _ in range(60):
        scores = rng.normal(0.0, 1.3, (3, 1024))
        scores[:, :3] = 50.0
        scatter.add(scores)
    assert scatter.quality(1.3**2, 3065, 1.0).chi2 == pytest.approx(1.0, abs=0.04)


def test_a_common_mode_that_moved_during_a_touch_shows_no_contact_after_it() -> None:
    decoder, rng = decoder_of(SKIN), np.random.default_rng(3)
    frames = [signals(common=c) for c in [*np.linspace(0.0, 30.0, 40), *[30.0] * 9]] + [0.0 * NOISE] * 14
    contacts = [len(decoder.decode(noisy(frame, rng, NOISE), NOISE).contacts) for frame in frames]
    assert (contacts[48], contacts[-10:]) == (1, [0] * 10)


@pytest.mark.parametrize(
    "off", [{"depth": 1.1}, {"modulus": 0.9}, {"position_m": 1e-4}], ids=lambda off: next(iter(off))
)
def test_a_wrong_model_is_contradicted_within_a_tenth_of_a_second(decoder: SkinDecoder, off: dict[str, Any]) -> None:
    contact = pressed(decoder, signals(**off), frames=10)
    assert contact.fit is not None
    assert contact.fit.chi2 > 1.1
    assert (contact.status, contact.reason) == ("contradicted", "fit_contradicted")


@pytest.mark.parametrize(
    ("off", "stated"),
    [
        ({"depth": 1.0 + OFF}, {"depth_std_m": OFF * DEPTH_M}),
        ({"modulus": 1.0 - OFF}, {"modulus_std_pascal": OFF * E}),
        ({"gain": 1.0 + OFF}, {"gain_std_common": OFF}),
        ({"position_m": 1e-4}, {"position_std_m": 1e-4}),
        ({"common": 0.3}, {}),
    ],
    ids=["depth", "modulus", "gain", "positions", "common mode"],
)
def test_systematic_deviations_cover_what_is_off(off: dict[str, Any], stated: dict[str, float]) -> None:
    contact = pressed(decoder_of(replace(SKIN, **stated)), signals(**off), frames=4 if "common" in off else 12)
    slip, patch, off_by = contact.slip, contact.patch, contact.systematic
    assert slip is not None
    error = [*(patch.force_newton - FORCE_NEWTON), *(patch.centroid_m - CENTRE_M), slip.radius_m - RADIUS_M]
    error += [slip.slip_margin - MARGIN, slip.friction_coefficient - FRICTION]
    noise = [*patch.force_std_newton, *patch.centroid_std_m, slip.radius_std_m]
    noise += [slip.slip_margin_std, slip.friction_coefficient_std]
    other = [*off_by.force_newton, *off_by.position_m, off_by.radius_m, off_by.slip_margin, off_by.friction_coefficient]
    assert (known := np.isfinite(error)).sum() >= 6
    assert (np.abs(error) < 2.0 * np.hypot(noise, other))[known].all()
    assert (np.abs(error) > 2.0 * np.array(noise)).any() or "position_m" in off  # which the noise alone does not cover


@pytest.mark.parametrize(("factor", "std", "found"), [(1, 0, ()), (0, 0, (SITE,)), (0.8, 0, (SITE,)), (0, 0.9, ())])
def test_a_site_that_fails_is_suspect_and_then_not_used(factor: float, std: float, found: tuple[int, ...]) -> None:
    decoder, is_site = decoder_of(replace(SKIN, gain_std=std)), np.arange(len(SITES_M)) == SITE
    clean = signals() * np.where(is_site, factor, 1.0)
    for checks in range(22):
        assert decoder.suspects == (found if checks >= 2 else ())
        frame = clean if checks != 10 else np.where(is_site, np.nan, clean)  # a lost signal shows nothing
        last = decoder.decode(noisy(frame, np.random.default_rng(checks), NOISE), NOISE).decoded
        decoder.check()
    assert (last.reason_code == "signals_lost") is bool(found)
