"""Contacts of a punch, an ellipse and other objects: named if a model fits, else contradicted."""

from collections.abc import Callable

import numpy as np
import pytest
from contact_scenes import DEPTH_M, FRICTION, NU, SITES_M, E, contact_signals, noise_std, summed_points

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.ellipse import EllipseLinearisation
from resonator_daemon.estimate.surface.fitting.shape_fit import ShapeFitter
from resonator_daemon.estimate.surface.fitting.slip_problem import Whitening
from resonator_daemon.estimate.surface.fitting.systematic import skin_changes
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_contacts import SkinContact
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder

CENTRE_M, FORCE_NEWTON, MARGIN = np.array([3e-4, -2e-4]), np.array([0.2, 0.1, 1.0]), 0.6
ALONG, ACROSS = np.array([-0.8, 0.6]), np.array([0.6, 0.8])  # the long half-axis, and the short one
LONG_M, SHORT_M = 2.8e-3, 1.9e-3
BALL = contact_signals(SITES_M, FORCE_NEWTON, CENTRE_M, 2.3e-3)
ASIDE = contact_signals(SITES_M, FORCE_NEWTON, (-4.5e-3, -4.5e-3), 1e-3)  # a second contact
NOISE_20_DB = np.full((3, len(SITES_M)), noise_std(BALL, 20.0))
SKIN = Skin(HalfSpace(E, NU), SITES_M, DEPTH_M, depth_std_m=0.01 * DEPTH_M)


def punch(depth_m: float = DEPTH_M) -> Floats:
    return np.einsum("f,fsn->sn", FORCE_NEWTON, summed_points(CENTRE_M, 2e-3 * np.eye(2), -0.5, depth_m))


def ellipse(depth_m: float = DEPTH_M, size: float = 1.0, move_m: float = 0.0) -> Floats:
    """Signals of a Hertz pressure over an ellipse, whose shear is less that of the part that sticks (Mindlin)."""
    axes_m = size * np.column_stack([LONG_M * ALONG, SHORT_M * ACROSS])
    sliding = FORCE_NEWTON * [1.0, 1.0, 0.0] / (1.0 - MARGIN)
    scales = 1.0, np.cbrt(MARGIN)
    whole, stuck = (summed_points(CENTRE_M + move_m, scale * axes_m, 0.5, depth_m) for scale in scales)
    total = np.einsum("f,fsn->sn", sliding + FORCE_NEWTON * [0.0, 0.0, 1.0], whole) - MARGIN * np.einsum(
        "f,fsn->sn", sliding, stuck
    )
    return np.asarray(total)


def balls(apart_m: float, share: float) -> Floats:
    """Two balls next to each other, the force of the second one a share of that of the first."""
    force, aside_m = FORCE_NEWTON / (1.0 + share), np.array([apart_m / 2.0, 0.0])
    first = contact_signals(SITES_M, force, CENTRE_M - aside_m, 1.6e-3)
    return first + contact_signals(SITES_M, share * force, CENTRE_M + aside_m, 1.6e-3 * np.cbrt(share))


@pytest.fixture(scope="module")
def decoder() -> SkinDecoder:
    return SkinDecoder(SKIN, DecodingOptions(background=False), NOISE_20_DB, lambda _: None)


def pressed(decoder: SkinDecoder, frames: list[Floats], seed: int = 1, check: int = 8) -> list[SkinContact]:
    """Return the contact in each of some frames from the third one on; one of the frames is followed by a check."""
    rng, contacts = np.random.default_rng(seed), []
    decoder.reset(Reason(ReasonCode.DECODER_RESET, "of a test"))
    decoder.start_cold()
    for number, clean in enumerate([np.zeros_like(BALL)] * 30 + frames):
        reading = decoder.decode(noisy_frame(clean, rng), NOISE_20_DB)
        if number == 30 + check:
            decoder.check()
        if number > 31:
            contacts += reading.contacts
    return contacts


def noisy_frame(clean: Floats, rng: np.random.Generator) -> Floats:
    return np.asarray(clean + NOISE_20_DB * rng.standard_normal(clean.shape))


@pytest.mark.parametrize(("name", "make"), [("punch", punch), ("ellipse", ellipse)])
def test_a_punch_and_an_ellipse_are_named_and_their_numbers_are_within_their_errors(
    decoder: SkinDecoder, name: str, make: Callable[[], Floats]
) -> None:
    contacts = pressed(decoder, [make()] * 40)
    before, after = contacts[4], contacts[10:]
    assert (before.status, before.reason) == ("contradicted", "fit_contradicted")
    assert {each.shape for each in contacts[:5]} == {None}
    assert {(each.status, each.reason, each.shape) for each in after} == {("ok", None, name)}
    scores, stds, short_m, area_m2 = (
        [],
        [],
        *((2e-3, np.pi * 2e-3**2) if make is punch else (SHORT_M, np.pi * LONG_M * SHORT_M)),
    )
    for each in after:
        patch, fit = each.patch, each.shape_fit
        error = [*(patch.force_newton - FORCE_NEWTON), *(patch.centroid_m - CENTRE_M), fit.short_half_axis_m - short_m]
        std = [*patch.force_std_newton, *patch.centroid_std_m, fit.short_half_axis_std_m]
        if make is ellipse:
            error += [each.slip.slip_margin - MARGIN, *(fit.long_half_axis_m - LONG_M * ALONG)]
            std += [each.slip.slip_margin_std, *fit.long_half_axis_std_m]
        else:
            assert np.isnan([each.slip.slip_margin, *fit.long_half_axis_m]).all()
            assert each.slip.reason is not None
            assert each.slip.reason.code == "no_slip_margin"
            assert each.area_std_m2 == pytest.approx(2.0 * np.pi * 2e-3 * fit.short_half_axis_std_m, rel=0.01)
        scores.append(np.divide(error, std))
        stds.append(std[:6])
        assert each.area_m2 == pytest.approx(area_m2, abs=5.0 * each.area_std_m2)
        assert (each.systematic.force_newton > 0.0).all()  # of the depth
        assert each.peak_newton >= patch.force_newton[2]
    assert (np.abs(scores) < 4.0).all()
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.5
    assert np.max(stds, axis=0)[:3].max() < 2.8e-3  # newtons
    assert np.max(stds, axis=0)[5] < 1.2e-5  # metres


@pytest.mark.parametrize("make", [punch, ellipse])
def test_systematic_errors_are_what_another_depth_changes(decoder: SkinDecoder, make: Callable[..., Floats]) -> None:
    patch, fitter = pressed(decoder, [make()] * 4)[-1].patch, ShapeFitter(SKIN, NOISE_20_DB, 6e-3)
    found = [fitter.fit(make(depth * DEPTH_M), NOISE_20_DB, patch, lambda: None) for depth in (0.99, 1.0, 1.01)]
    less, middle, more = (fit.slip for fit in found if fit is not None)
    changes = np.array([*(more.force_newton - less.force_newton), *(more.centre_m - less.centre_m)]) / 2.0
    std = np.sqrt(middle.systematic.diagonal())[[3, 4, 5, 0, 1]]
    assert std[:3] == pytest.approx(np.abs(changes[:3]), rel=0.05, abs=1e-5)
    assert std[3:] == pytest.approx(np.abs(changes[3:]), rel=0.05, abs=1e-7)


def test_an_ellipse_is_followed_while_it_moves_and_grows(decoder: SkinDecoder) -> None:
    frames = [ellipse()] * 12 + [ellipse(DEPTH_M, 1.0 + 0.01 * step, 3e-5 * step) for step in range(12)]
    last = pressed(decoder, frames)[-1]
    assert (last.status, last.shape) == ("ok", "ellipse")
    assert last.shape_fit.short_half_axis_m == pytest.approx(1.11 * SHORT_M, abs=4e-5)
    assert last.shape_fit.long_half_axis_m == pytest.approx(1.11 * LONG_M * ALONG, abs=6e-5)
    assert last.patch.centroid_m == pytest.approx(CENTRE_M + 3.3e-4, abs=2e-5)


@pytest.mark.parametrize(
    ("later", "found"),
    [
        ([balls(2e-3, 0.5)] * 16, ("contradicted", None)),
        ([BALL] * 16, ("ok", "ball")),
        ([punch() + ASIDE] * 8 + [punch()] * 8, ("contradicted", None)),
    ],
    ids=["merged", "ball", "second contact"],
)
def test_a_shape_is_discarded_when_it_no_longer_fits(
    decoder: SkinDecoder, later: list[Floats], found: tuple[str, str | None]
) -> None:
    contacts = pressed(decoder, [punch()] * 14 + later)
    assert contacts[10].shape == "punch"
    assert (contacts[-1].status, contacts[-1].shape) == found


def test_a_common_offset_is_followed_under_a_shape(decoder: SkinDecoder) -> None:
    clean = ellipse()
    last = pressed(decoder, [clean + common * NOISE_20_DB for common in np.linspace(0.0, 0.6, 40)])[-1]
    assert last.shape == "ellipse"
    assert last.patch.force_newton == pytest.approx(FORCE_NEWTON, abs=1e-2)
    assert decoder.contacts.offset == pytest.approx(np.full(3, 0.55), abs=0.15)


def test_signals_of_an_ellipse_change_with_depth_as_by_dimensional_analysis() -> None:
    parameters = np.array([*CENTRE_M, SHORT_M, *FORCE_NEWTON, MARGIN, 1.5e-3, -1e-3])

    def at(depth: float) -> EllipseLinearisation:
        model = DiscModel(SKIN.half_space, SITES_M, depth * DEPTH_M, 4e-3, power=0.0)
        return EllipseLinearisation(model, parameters, Whitening(model, np.ones(BALL.shape, np.bool_), np.ones((3, 1))))

    expected = (at(1.01).value - at(0.99).value) / 0.02
    assert np.linalg.norm(skin_changes(SKIN, at(1.0))[0] - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.parametrize(("apart_m", "share"), [(1.6e-3, 1.0), (2.4e-3, 0.1), (2.4e-3, 1.0)])
def test_two_objects_that_merge_remain_contradicted(decoder: SkinDecoder, apart_m: float, share: float) -> None:
    contacts = pressed(decoder, [balls(apart_m, share)] * 14)[6:]
    assert {(each.status, each.shape) for each in contacts} == {("contradicted", None)}


@pytest.mark.parametrize("depth", [1.06, 1.07, 1.2])
def test_a_wrong_depth_is_no_other_shape(decoder: SkinDecoder, depth: float) -> None:
    clean = contact_signals(SITES_M, FORCE_NEWTON, CENTRE_M, 2.3e-3, depth_m=depth * DEPTH_M)
    contacts = [each for seed in range(6) for each in pressed(decoder, [clean] * 20, seed)[6:]]
    assert {(each.status, each.shape) for each in contacts} <= {("contradicted", None), ("ok", "ball")}
    assert sum(each.status == "ok" for each in contacts) <= 6  # of 84


def test_a_shape_that_was_fitted_while_its_contact_ended_is_not_followed(decoder: SkinDecoder) -> None:
    assert pressed(decoder, [punch()] * 8, check=99)[-1].status == "contradicted"
    meanwhile = iter([np.zeros_like(BALL)])

    def pause() -> None:
        for frame in meanwhile:
            decoder.decode(frame, NOISE_20_DB)

    decoder.contacts.fit_shapes(pause)
    after = [contact for _ in range(3) for contact in decoder.decode(punch(), NOISE_20_DB).contacts]
    assert {each.shape for each in after} == {None}


def test_a_shape_without_most_of_its_signals_is_not_fitted(decoder: SkinDecoder) -> None:
    patch, fitter = pressed(decoder, [punch()] * 4)[-1].patch, ShapeFitter(SKIN, NOISE_20_DB, 6e-3)
    before = fitter.fit(punch(), NOISE_20_DB, patch, lambda: None)
    few = np.where(np.random.default_rng(1).random(len(SITES_M)) < 0.2, punch(), np.nan)
    assert [fitter.follow(before, signals, NOISE_20_DB) is None for signals in (punch(), few)] == [False, True]


def test_a_moving_ball_is_always_reported_as_ball(decoder: SkinDecoder) -> None:
    frames = []
    for step in range(300):
        shear = 0.5 * FRICTION * np.sin(step / 40.0)
        frames.append(contact_signals(SITES_M, (shear, 0.1, 1.0), CENTRE_M + 1e-5 * step, 2.3e-3))
    contacts = pressed(decoder, frames, seed=12, check=150)
    assert {(each.status, each.shape) for each in contacts} == {("ok", "ball")}
