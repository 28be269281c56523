"""The parametric contact fit on 16 jittered sites, on contacts whose signals come from closed forms in space."""

from functools import cache

import numpy as np
import pytest
from contact_scenes import NU, E, contact_signals
from scipy.stats import norm

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.fitting.parametric_decoder import ParametricDecoder, sparse_reason
from resonator_daemon.estimate.surface.patches import Patch

RADIUS_M = 2e-3
SKIN = HalfSpace(E, NU)
QUERIES_M = np.stack(np.meshgrid(*[(np.arange(41) - 20) * 5e-4] * 2), axis=-1).reshape(-1, 2)


def jittered(rng: np.random.Generator) -> Floats:
    """16 sites on 20 mm x 20 mm."""
    axis = (np.arange(4) - 1.5) * 5e-3
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + rng.uniform(-1e-3, 1e-3, (16, 2))


SITES_M = jittered(np.random.default_rng(0))


def signals(
    centre_m: Floats,
    depth_m: float,
    force_newton: tuple[float, float, float] = (0.0, 0.0, 1.0),
    sites_m: Floats = SITES_M,
) -> Floats:
    return contact_signals(sites_m, force_newton, centre_m, RADIUS_M, depth_m=depth_m)


def noise_std(depth_m: float, decibel: float) -> float:
    """Noise below the signal 3 p_n / (2 E) under the middle of a contact."""
    peak = signals(np.zeros(2), depth_m, sites_m=np.zeros((1, 2)))[0, 0]
    return float(np.abs(peak) * 10 ** (-decibel / 20))


@cache
def decoder(depth_m: float, decibel: float, gain_std: float = 0.0) -> ParametricDecoder:
    return ParametricDecoder(
        SKIN, SITES_M, depth_m, noise_std(depth_m, decibel), gain_std=gain_std, query_positions_m=QUERIES_M
    )


class Scores:
    """Errors of many contacts, in mm and in standard deviations."""

    def __init__(
        self, template: ParametricDecoder, depth_m: float, std: float, shear: float, count: int, gain_std: float = 0.0
    ) -> None:
        rng = np.random.default_rng(1)
        self.apart_mm: list[float] = []
        self.of_centre: list[Floats] = []
        self.of_force: list[Floats] = []
        self.of_moment: list[Floats] = []
        self.statuses: list[str] = []
        for _ in range(count):
            centre = rng.uniform(-7.5e-3, 7.5e-3, 2)
            angle = rng.uniform(0.0, 2.0 * np.pi)
            force = (shear * np.cos(angle), shear * np.sin(angle), 1.0)
            frame = signals(centre, depth_m, force) * (1.0 + gain_std * rng.standard_normal((3, 16)))
            decoded, patch = template.decode(frame + std * rng.standard_normal(frame.shape))
            self.statuses.append(str(decoded.status))
            self.apart_mm.append(np.inf)
            if patch:
                self.apart_mm[-1] = float(np.hypot(*(patch.centroid_m - centre)) * 1e3)
                self.of_centre.append((patch.centroid_m - centre) / patch.centroid_std_m)
                self.of_force.append((patch.force_newton - force) / patch.force_std_newton)
                x, y = centre
                moment = np.array([y, -x, x * force[1] - y * force[0]])
                self.of_moment.append((patch.moment_newton_m - moment) / patch.moment_std_newton_m)


def rms(scores: list[Floats]) -> Floats:
    return np.asarray(np.sqrt(np.mean(np.square(scores), axis=0)), np.float64)


@pytest.mark.parametrize(("depth_mm", "decibel", "shear", "median_mm"), [(3, 20, 0.0, 0.32), (2, 40, 0.3, 0.12)])
def test_location_and_honest_errors(depth_mm: float, decibel: float, shear: float, median_mm: float) -> None:
    depth_m = depth_mm * 1e-3
    scores = Scores(decoder(depth_m, decibel), depth_m, noise_std(depth_m, decibel), shear, 60)
    assert np.median(scores.apart_mm) <= median_mm
    assert scores.statuses.count("ok") >= 58
    assert ((rms(scores.of_centre) > 0.6) & (rms(scores.of_centre) < 1.4)).all()
    assert ((rms(scores.of_force)[:2] > 0.5) & (rms(scores.of_force)[:2] < 1.4)).all()
    for normal in (np.array(scores.of_force)[:, 2], np.array(scores.of_moment)[:, :2]):
        assert 0.3 < np.median(np.abs(normal)) < 1.1  # for a Gaussian 0.67
    assert 0.5 < rms(scores.of_moment)[2] < 1.4


def test_one_site_alone_cannot_tell_a_place() -> None:
    sites = np.array([[0.0, 0.0], [12e-3, 0.0], [0.0, 12e-3]])
    frame = signals(np.array([5e-4, 5e-4]), 1e-3, sites_m=sites)
    decoded, patch = ParametricDecoder(SKIN, sites, 1e-3, 0.05 * float(np.abs(frame).max())).decode(frame)
    assert (decoded.status, patch) == ("ambiguous", None)
    assert np.isnan(decoded.traction_pascal).all()


def test_more_signals_than_unknowns_are_needed() -> None:
    sites = np.array([[0.0, 0.0], [5e-3, 0.0], [0.0, 5e-3]])
    frame = signals(np.array([2e-3, 2e-3]), 2e-3, sites_m=sites)
    three = ParametricDecoder(SKIN, sites, 2e-3, 1e-3 * float(np.abs(frame).max()))
    frame[0, 1:] = np.nan
    assert three.decode(frame)[0].status != "no_signal"
    frame[1, 1] = np.nan
    assert three.decode(frame)[0].status == "no_signal"  # six signals, six unknowns


def test_gain_errors() -> None:
    told, untold = (
        Scores(decoder(2e-3, 60, gain_std), 2e-3, noise_std(2e-3, 60), 0.2, 25, gain_std=0.05)
        for gain_std in (0.05, 0.0)
    )
    assert ((rms(told.of_centre) > 0.7) & (rms(told.of_centre) < 1.8)).all()
    assert (rms(told.of_force) < 1.4).all()
    assert (rms(untold.of_centre) > 3.0).all()


def found(frame: Floats, depth_m: float = 2e-3, decibel: float = 40) -> Patch:
    decoded, patch = decoder(depth_m, decibel).decode(frame)
    assert decoded.status == "ok"
    assert patch is not None
    return patch


def test_without_noise_all_is_found() -> None:
    """Shear of full sliding has the profile of the pressure."""
    centre, force = np.array([1.3e-3, -2.1e-3]), (0.3, -0.4, 1.0)
    frame = signals(centre, 2e-3, force)
    exact = ParametricDecoder(SKIN, SITES_M, 2e-3, 1e-3 * noise_std(2e-3, 40), query_positions_m=QUERIES_M)
    decoded, patch = exact.decode(frame, displacement=True)
    assert patch is not None
    np.testing.assert_allclose(patch.centroid_m, centre, atol=2e-6)
    np.testing.assert_allclose(patch.force_newton, force, atol=1e-3)
    assert patch.radius_m == pytest.approx(RADIUS_M, rel=2e-3)
    x, y = centre
    np.testing.assert_allclose(patch.moment_newton_m, [y, -x, -0.4 * x - 0.3 * y], atol=5e-6)
    distance = np.hypot(*(QUERIES_M - centre).T)
    height = np.sqrt(np.maximum(1.0 - (distance / RADIUS_M) ** 2, 0.0)) * 1.5 / (np.pi * RADIUS_M**2)
    clear = np.abs(distance - RADIUS_M) > 5e-5
    np.testing.assert_allclose(
        decoded.traction_pascal[:, clear], np.outer(force, height)[:, clear], atol=0.01 * height.max()
    )
    np.testing.assert_array_equal(patch.places, np.flatnonzero(decoded.traction_pascal[2] > 0.0))
    assert decoded.displacement_m is not None
    # Indentation a^2 / R where a^3 = 3 F R (1 - nu^2) / (4 E) (Johnson, section 4.2), and half of it at the rim
    deepest = decoded.displacement_m[2].max()
    assert deepest == pytest.approx(0.75 * (1.0 - NU**2) / (E * RADIUS_M), rel=0.02)
    at_rim = np.abs(distance - RADIUS_M).argmin()
    assert decoded.displacement_m[2, at_rim] == pytest.approx(deepest / 2.0, rel=0.05)
    assert decoded.displacement_m[0, distance.argmin()] > 0.0 > decoded.displacement_m[1, distance.argmin()]


def test_map_and_its_error_bars() -> None:
    rng = np.random.default_rng(2)
    within: list[Floats] = []
    for _ in range(20):
        centre = rng.uniform(-6e-3, 6e-3, 2)
        frame = signals(centre, 2e-3) + noise_std(2e-3, 30) * rng.standard_normal((3, 16))
        decoded, _ = decoder(2e-3, 30).decode(frame)
        distance = np.hypot(*(QUERIES_M - centre).T)
        truth = np.sqrt(np.maximum(1.0 - (distance / RADIUS_M) ** 2, 0.0)) * 1.5 / (np.pi * RADIUS_M**2)
        pressed = distance < RADIUS_M
        off = np.abs(decoded.traction_pascal[2] - truth)[pressed]
        within.append(np.array([off <= bound * decoded.traction_std_pascal[2, pressed] for bound in (1.0, 2.0)]))
    one, two = np.hstack(within).mean(axis=1)
    assert 0.55 < one < 0.85
    assert two > 0.88


def test_noise_alone_is_no_contact() -> None:
    noise = noise_std(2e-3, 30) * np.random.default_rng(3).standard_normal((50, 3, 16))
    chi2 = []
    for frame in [np.zeros((3, 16)), *noise]:
        decoded, patch = decoder(2e-3, 30).decode(frame, displacement=True)
        assert (decoded.status, patch) == ("ok", None)
        assert decoded.displacement_m is not None
        assert not decoded.traction_pascal.any()
        assert not decoded.displacement_m.any()
        assert np.isfinite(decoded.traction_std_pascal).all()
        chi2.append(decoded.chi2)
    assert decoded.reason == "parametric contact fit: 16 sites, a map needs at least 40; no contact"
    assert np.mean(chi2[1:]) == pytest.approx(1.0, abs=0.1)
    # A touch between sites hides better than one on a site.
    std = decoder(2e-3, 30).decode(noise[0])[0].traction_std_pascal[2]
    nearest = np.hypot(*(QUERIES_M[:, None] - SITES_M).transpose(2, 0, 1)).min(axis=1)
    assert std[nearest.argmin()] < 0.5 * std[nearest.argmax()]
    at = np.hypot(*(QUERIES_M - SITES_M[5]).T).argmin()
    noise[0, :, 5] = np.nan
    assert decoder(2e-3, 30).decode(noise[0])[0].traction_std_pascal[2, at] > 2.0 * std[at]


def test_two_contacts_are_not_one() -> None:
    both = signals(np.array([-5e-3, -4e-3]), 2e-3) + signals(np.array([5e-3, 5e-3]), 2e-3)
    decoded, patch = decoder(2e-3, 40).decode(both)
    assert (decoded.status, patch) == ("rejected", None)
    assert np.isnan(decoded.traction_pascal).all()


def test_lost_signals() -> None:
    centre = np.array([1.0e-3, 0.5e-3])
    frame = signals(centre, 2e-3)
    frame[:, np.hypot(*(SITES_M - centre).T).argmin()] = np.nan
    frame[1, 3], frame[2, 4] = np.inf, 1e6
    assert np.hypot(*(found(frame).centroid_m - centre)) < 2e-4
    frame[:, 6:] = np.nan
    decoded, _ = decoder(2e-3, 40).decode(frame)
    assert decoded.status == "no_signal"
    assert np.isnan(decoded.traction_std_pascal).all()


def test_evidence() -> None:
    std = noise_std(3e-3, 20)
    noise = 0.9 * std * np.random.default_rng(5).standard_normal((3, 16))
    assert decoder(3e-3, 20).decode(noise)[0].log_evidence == pytest.approx(norm.logpdf(noise, scale=std).sum())
    # Of a frame without noise what remains is the constant, less Schwarz's penalty for six unknowns.
    frame = signals(np.array([1e-3, 0.0]), 3e-3)
    expected = 48 * norm.logpdf(0.0, scale=std) - 3.0 * np.log(48)
    assert decoder(3e-3, 20).decode(frame)[0].log_evidence == pytest.approx(expected, abs=0.1)


def test_when_a_map_misleads() -> None:
    def sites(count: int, pitch_mm: float) -> Floats:
        axis = np.arange(count) * pitch_mm * 1e-3
        return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)

    assert sparse_reason(SITES_M, 3e-3) == "parametric contact fit: 16 sites, a map needs at least 40"
    assert "39 sites" in str(sparse_reason(sites(8, 2.9)[:39], 1e-3))
    assert sparse_reason(sites(8, 2.9)[:40], 1e-3) is None
    assert sparse_reason(sites(8, 3.1), 1e-3) == (
        "parametric contact fit: sites 3.1 mm apart at a depth of 1 mm, a map needs at most 3 depths"
    )
