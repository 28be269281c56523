"""The rows of docs/research/errata.md: the print fails, the correction holds, by means that share no formula."""

import random
from functools import cache

import numpy as np
import pytest
from boundary_value_problem import BoundaryValueProblem, Numbers, mp
from printed_equations import EQUATIONS, J, Symbols

from resonator_daemon.estimate.elastic import HalfSpace
from resonator_daemon.estimate.elastic.transfer_matrices import MATRICES

TINY = mp.mpf("1e-40")


def samples() -> list[Symbols]:
    """Waves in all four quadrants; the last two are incompressible."""
    rng = random.Random(5)

    def uniform(low: float, high: float) -> mp.mpf:
        return mp.mpf(rng.uniform(low, high))

    waves = []
    for number in range(8):
        nu = mp.mpf("0.5") if number > 5 else uniform(-0.9, 0.5)
        x, y = (rng.choice((-1, 1)) * uniform(0.3, 2.0) for _ in "xy")
        waves.append(Symbols(x=x, y=y, z=uniform(0.2, 1.5), nu=nu, mu=uniform(0.5, 2.0)))
    return waves


SAMPLES = samples()


@cache
def truth(v: Symbols, source: str, z: mp.mpf | None = None) -> dict[str, Numbers]:
    problem = BoundaryValueProblem(v.x, v.y, v.nu, v.mu)
    matrices = problem.matrices(source, v.z if z is None else z)
    assert problem.residual < TINY
    return matrices


def largest(matrix: Numbers) -> mp.mpf:
    return max(abs(entry) for entry in matrix.ravel())


def determinant(rows: list[Numbers] | Numbers) -> mp.mpc:
    return mp.det(mp.matrix(np.array(rows).tolist()))


# --- the matrices, eqs (2), (4), (14)-(23)


@pytest.mark.parametrize("name", EQUATIONS)
def test_matrix_differs_from_the_solution_in_the_listed_entries_alone(name: str):
    equation = EQUATIONS[name]
    deviation: dict[tuple[int, ...], mp.mpf] = {}
    for v in SAMPLES:
        solution = truth(v, equation.source, mp.mpf(0) if name == "eq18" else None)[equation.output]
        scale = largest(solution)
        for entry, error in np.ndenumerate(equation.as_printed(v) - solution):
            deviation[entry] = max(abs(error) / scale, deviation.get(entry, 0))
        assert largest(equation.corrected(v) - solution) < TINY * scale
    wrong = {entry for entry, largest_seen in deviation.items() if largest_seen > TINY}
    assert wrong == set(equation.corrections(SAMPLES[0]))
    assert all(deviation[entry] > 0.05 for entry in wrong)


@pytest.mark.parametrize(("output", "source"), MATRICES)
def test_library_agrees_with_the_solution(output: str, source: str):
    for v in SAMPLES:
        expected = truth(v, source)[output].astype(np.complex128)
        body = HalfSpace(float(2 * v.mu * (1 + v.nu)), float(v.nu))
        depth = 0.0 if output == "traction" else float(v.z)
        found = body.transfer_matrix(output, source, float(v.x), float(v.y), depth)  # type: ignore[arg-type]
        np.testing.assert_allclose(found, expected, atol=1e-14 * np.abs(expected).max(), rtol=0)


def test_sign_of_the_traction_in_the_matrices_is_not_that_of_the_text_before_eq13():
    at_surface = [EQUATIONS["eq16"].as_printed(Symbols(v.x, v.y, mp.mpf(0), v.nu, v.mu)) for v in SAMPLES]
    for stress in at_surface:
        assert largest(stress[[4, 5, 2]] + np.eye(3, dtype=int)) < TINY


# --- the derivation, eqs (9)-(13), and the determinant (3)


def test_eq09_needs_the_trace():
    """A bar drawn out lengthwise has free sides; only with the trace in Hooke's law do they stay free."""
    nu, youngs_modulus = mp.mpf("0.3"), mp.mpf(2)
    mu, lame = youngs_modulus / (2 * (1 + nu)), nu * youngs_modulus / ((1 + nu) * (1 - 2 * nu))
    strain = [mp.mpf(1), -nu, -nu]
    printed = [lame * eps + 2 * mu * eps for eps in strain]
    corrected = [lame * sum(strain) + 2 * mu * eps for eps in strain]
    assert max(abs(a - b) for a, b in zip(corrected, [youngs_modulus, 0, 0], strict=True)) < TINY
    assert abs(printed[1]) > 0.5


def test_eq11_operator():
    for v in SAMPLES[:6]:
        w, d = v.w, mp.mpf("1.7")
        lame = 2 * v.mu * v.nu / (1 - 2 * v.nu)
        c = mp.diag([2 * v.mu] * 3 + [v.mu] * 3)
        c[:3, :3] += lame * mp.ones(3)
        jx, jy = J * v.x, J * v.y
        kt = mp.matrix([[jx, 0, 0, jy, d, 0], [0, jy, 0, jx, 0, d], [0, 0, d, 0, jx, jy]])
        b2 = (lame + 2 * v.mu) / v.mu
        printed = mp.matrix(
            [
                [d**2 - w**2 - v.x**2 * (b2 - 1), -v.x * v.y * (b2 - 1), jx * (b2 - 1) * d],
                [-v.x * v.y * (b2 - 1), d**2 - w**2 - v.y**2 * (b2 - 1), jy * (b2 - 1) * d],
                [jx * (b2 - 1) * d, jy * (b2 - 1) * d, b2 * (d**2 - w**2) + w**2 * b2],
            ]
        )
        corrected = printed.copy()
        corrected[2, 2] = b2 * (d**2 - w**2) + w**2 * (b2 - 1)
        product = kt * c * kt.T
        assert mp.mnorm(product - v.mu * corrected, 1) < TINY
        assert abs(product[2, 2] - v.mu * printed[2, 2]) > 0.1
        stated = b2 * v.mu**3 * (d**2 - w**2) ** 3
        assert abs(mp.det(product) - stated) < TINY * abs(stated)
        assert abs(v.mu**3 * mp.det(printed) / stated - 1) > 0.01


def test_eq12_holds_and_eq13_needs_minus_2_in_row_3():
    for v in SAMPLES:
        problem = BoundaryValueProblem(v.x, v.y, v.nu, v.mu)
        unknowns = problem.solve("displacement")
        w, jx, jy, share = v.w, J * v.x, J * v.y, 1 - 2 * v.nu  # share is 1 / (beta^2 - 1)
        (a_x, b_x), (a_y, b_y), (a_z, b_z) = (unknowns[2 * i : 2 * i + 2] for i in range(3))
        for left, right in [
            (a_z, (jx * a_x + jy * a_y + (1 + 2 * share) * b_z) / w),  # (beta^2 + 1) / (beta^2 - 1) = 1 + 2 share
            (b_x, -jx / w * b_z),
            (b_y, -jy / w * b_z),
        ]:
            assert largest(left - right) < TINY
        printed = np.array(
            [
                [-(2 * v.x**2 + v.y**2), -v.x * v.y, 2 * jx * (share + w * v.z)],
                [-v.x * v.y, -(v.x**2 + 2 * v.y**2), 2 * jy * (share + w * v.z)],
                [jx * w, jy * w, w * (1 + share + w * v.z)],  # beta^2 / (beta^2 - 1) = 1 + share
            ]
        )
        stress = v.mu * mp.exp(-w * v.z) / w * (printed @ np.array([a_x, a_y, b_z]))
        expected = truth(v, "displacement")["stress"][[4, 5, 2]]
        assert largest(stress[:2] - expected[:2]) < TINY
        assert largest(-2 * stress[2] - expected[2]) < TINY
        assert largest(stress[2] - expected[2]) > 0.01


def test_eq03_determinant():
    for v in SAMPLES:
        youngs_modulus = 2 * v.mu * (1 + v.nu)
        found = determinant(truth(v, "traction", mp.mpf(0))["displacement"])
        corrected = 2 * (1 + v.nu) ** 3 * v.k / (youngs_modulus**3 * v.w**3)
        printed = 2 * (1 + v.nu) ** 3 / v.k * youngs_modulus**3 / v.w**3
        assert abs(found / corrected - 1) < TINY
        assert abs(found / (v.k / (4 * v.mu**3 * v.w**3)) - 1) < TINY
        assert abs(found / printed - 1) > 0.01


XY = 3  # row of the strains

# --- the estimator: eq (5), its functional, its prior


def random_complex(rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal((3, 3)) + 1j * rng.standard_normal((3, 3))


def random_power(rng: np.random.Generator) -> np.ndarray:
    root = random_complex(rng)
    return root @ root.conj().T


def mean_square_error(gain: np.ndarray, t: np.ndarray, p_s: np.ndarray, p_n: np.ndarray) -> float:
    bias = gain @ t - np.eye(3)
    return float(np.trace(bias @ p_s @ bias.conj().T + gain @ p_n @ gain.conj().T).real)


def printed_gain(t: np.ndarray, p_s: np.ndarray, p_n: np.ndarray) -> np.ndarray:
    return np.linalg.solve(p_s @ t.conj().T @ t + p_n, p_s @ t.conj().T)


def corrected_gain(t: np.ndarray, p_s: np.ndarray, p_n: np.ndarray) -> np.ndarray:
    return p_s @ t.conj().T @ np.linalg.inv(t @ p_s @ t.conj().T + p_n)


def test_eq05_printed_is_optimal_for_white_equal_noise_alone():
    rng = np.random.default_rng(11)
    ratios = []
    for _ in range(500):
        t, p_s, p_n = random_complex(rng), random_power(rng), random_power(rng)
        least = mean_square_error(corrected_gain(t, p_s, p_n), t, p_s, p_n)
        for _ in range(3):
            other = corrected_gain(t, p_s, p_n) + 0.01 * random_complex(rng)
            assert mean_square_error(other, t, p_s, p_n) > least
        ratios.append(mean_square_error(printed_gain(t, p_s, p_n), t, p_s, p_n) / least)
        scalar = rng.uniform(0.1, 10.0) * np.eye(3)
        np.testing.assert_allclose(printed_gain(t, p_s, scalar), corrected_gain(t, p_s, scalar), rtol=1e-6, atol=1e-9)
    assert min(ratios) > 1.0
    assert 2.0 < np.median(ratios) < 5.0


def test_eq05_weight_is_wiener_after_whitening_alone():
    rng = np.random.default_rng(12)
    t, p_s, p_n = random_complex(rng), random_power(rng), random_power(rng)
    weighted = np.linalg.solve(t.conj().T @ t + np.linalg.solve(p_s, p_n), t.conj().T)
    np.testing.assert_allclose(weighted, printed_gain(t, p_s, p_n), rtol=1e-8)
    white = np.linalg.inv(np.linalg.cholesky(p_n))
    whitened = white @ t
    gain = np.linalg.solve(whitened.conj().T @ whitened + np.linalg.inv(p_s), whitened.conj().T) @ white
    np.testing.assert_allclose(gain, corrected_gain(t, p_s, p_n), rtol=1e-8)


def test_eq05_functional_needs_the_conjugate():
    """With it, the stated estimate is the minimum; without it, the functional is not even real."""
    rng = np.random.default_rng(13)
    t, h, s = random_complex(rng), random_power(rng), random_complex(rng)[0]
    estimate = np.linalg.solve(t.conj().T @ t + h, t.conj().T @ s)
    residual = t @ estimate - s

    def functional(phi: np.ndarray) -> float:
        return float(np.sum(np.abs(t @ phi - s) ** 2) + (phi.conj() @ h @ phi).real)

    assert all(functional(estimate + 1e-3 * random_complex(rng)[0]) > functional(estimate) for _ in range(50))
    assert abs((residual @ residual).imag) > 0.01 * np.sum(np.abs(residual) ** 2)


def printed_prior(mu_f: float) -> np.ndarray:
    return np.array([[mu_f**2, 0, mu_f], [0, mu_f**2, mu_f], [mu_f, mu_f, 1]])


@pytest.mark.parametrize("mu_f", [0.1, 0.5, 1.0, 2.0])
def test_coulomb_prior_printed_is_no_covariance(mu_f: float):
    np.testing.assert_allclose(np.linalg.det(printed_prior(mu_f)), -(mu_f**4), rtol=1e-12)
    assert np.linalg.eigvalsh(printed_prior(mu_f))[0] < 0
    angle = np.arange(12) * (2 * np.pi / 12)
    load = np.array([mu_f * np.cos(angle), mu_f * np.sin(angle), np.ones(12)])  # sliding along each direction in turn
    np.testing.assert_allclose(load @ load.T / 12, np.diag([mu_f**2 / 2, mu_f**2 / 2, 1]), atol=1e-15)
    assert np.linalg.eigvalsh(load @ load.T / 12)[0] > 0
    np.testing.assert_allclose(np.hypot(mu_f, mu_f), np.sqrt(2) * mu_f)  # |f_t| of the stated f_x = f_y = mu_f f_z


def test_coulomb_prior_printed_can_make_eq05_singular():
    np.testing.assert_allclose(np.linalg.eigvalsh(printed_prior(0.5))[0], -0.1754, atol=5e-5)
    t = HalfSpace(1.0, 0.5).transfer_matrix("sensor", "traction", 0.7, 0.4, 1.0)
    operator = printed_prior(0.5) @ t.conj().T @ t
    eigenvalues = np.linalg.eigvals(operator)
    np.testing.assert_allclose(eigenvalues.imag, 0.0, atol=1e-12)
    noise = -eigenvalues.real.min()
    assert noise > 0
    singular_values = np.linalg.svd(operator + noise * np.eye(3), compute_uv=False)
    assert singular_values[-1] < 1e-13 * singular_values[0]


# --- contact with partial slip, section 4

F, A, C, MU_F = 1.3, 1.7, 1.02, 0.4
NORMAL = {"printed": F / (np.pi * A**2), "corrected": 3 * F / (2 * np.pi * A**2)}
RELIEF = {"printed": C / A * F / (np.pi * A**2), "corrected": C / A * 3 * MU_F * F / (2 * np.pi * A**2)}


def test_hertz_factors_let_the_stick_zone_move_as_one():
    """u_x of the surface (Cerruti): along a chord of the disc the traction is a half ellipse, whose area is known."""
    nu = 0.3
    angle = np.arange(24) * (np.pi / 24)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.6 * C, 0.6 * C, (2, 20, 1))

    def displacement(amplitude: float, radius: float) -> np.ndarray:
        distance = x * np.sin(angle) - y * np.cos(angle)
        along_chord = np.pi * amplitude / (2 * radius) * (radius**2 - distance**2)
        return ((1 - nu + nu * np.cos(angle) ** 2) * along_chord).mean(axis=1)

    moved = {form: displacement(MU_F * NORMAL[form], A) - displacement(RELIEF[form], C) for form in NORMAL}
    assert np.ptp(moved["corrected"]) < 1e-14 * np.abs(moved["corrected"]).max()
    assert np.ptp(moved["printed"]) > 0.1 * np.abs(moved["printed"]).max()


def test_eq06_is_reversed():
    """In the solution of eq (7) the stick zone r < c lies below Coulomb's limit, the slip ring on it."""
    r = np.linspace(0.0, 0.999 * A, 200)
    stick = r < C
    pressure = NORMAL["corrected"] * np.sqrt(1 - (r / A) ** 2)
    traction = MU_F * pressure - RELIEF["corrected"] * np.sqrt(np.maximum(1 - (r / C) ** 2, 0.0))
    assert (traction[stick] < MU_F * pressure[stick]).all()
    np.testing.assert_allclose(traction[~stick], MU_F * pressure[~stick], rtol=1e-14)


# --- statements that do not hold


def far_field(angle: float, w: str, nu: str, source: str = "traction") -> dict[str, Numbers]:
    wave = Symbols(mp.mpf(w) * mp.cos(angle), mp.mpf(w) * mp.sin(angle), mp.mpf(1), mp.mpf(nu), mp.mpf(1))
    return truth(wave, source)


def test_stated_finite_matrices():
    """Displacements grow as 1 / w; strains stay bounded, but each direction has its own limit."""
    near, nearer = far_field(0.3, "1e-8", "0.3"), far_field(0.3, "1e-9", "0.3")
    assert abs(largest(nearer["displacement"]) / largest(near["displacement"]) - 10) < 1e-6
    assert largest(nearer["strain"] - near["strain"]) < 1e-7
    assert largest(far_field(1.2, "1e-8", "0.3")["strain"] - near["strain"]) > 0.1


def test_stated_rank_for_displacement_input():
    """Strains and mean stress of a displacement vanish with w, a rigid motion being invisible."""
    near, nearer = (far_field(0.3, w, "0.3", "displacement") for w in ("1e-8", "1e-9"))
    for output in ("strain", "stress", "p_n", "traction"):
        assert abs(largest(near[output]) / largest(nearer[output]) - 10) < 1e-6
    assert abs(determinant(near["sensor"]) / determinant(nearer["sensor"]) - 1000) < 1e-4


def test_stated_uniform_pressure_alone_escapes_the_strains():
    """At nu = 1/2 all six strains together have rank 2, at every frequency."""
    for v in SAMPLES:
        values = mp.svd_c(mp.matrix(truth(v, "traction")["strain"].tolist()), compute_uv=False)
        lost = values[2] / values[0]
        assert lost < TINY if v.nu == 0.5 else lost > 1e-3


@pytest.mark.parametrize("nu", ["0", "0.5"])
def test_stated_minimum_of_eps_xy_at_the_origin(nu: str):
    """Towards omega = 0 the power of eps_xy depends on the direction, is never 0, and is larger than farther out."""

    def power(w: str, angle: float) -> float:
        return float(sum(abs(entry) ** 2 for entry in far_field(angle, w, nu)["strain"][XY]))

    angles = np.arange(12) * (np.pi / 12)
    inner = np.array([power("1e-9", angle) for angle in angles])
    assert inner.min() > 0.05
    assert inner.max() > 1.2 * inner.min()
    assert (inner > [power("0.1", angle) for angle in angles]).all()
