"""Contact without friction: accuracy and time for a Hertz contact, of this and other programs; residual of iterations.

Run it with `python benchmarks/elastic_contact.py [ROUNDS]`. Times are medians over interleaved rounds;
each program stops at 1e-8 by its own measure of error. Where others use the machine too, threads that wait for each
other cost the peers dearly: OMP_NUM_THREADS=1 makes it fair.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.elastic.contact import press
from resonator_daemon.elastic.influence import SurfaceCompliance
from resonator_daemon.elastic.profiles import flat_punch, paraboloid

try:
    import aspher
except ImportError:
    aspher = None
try:
    import tamaas
except ImportError:
    tamaas = None


SIDE_M, CONTACT_RADIUS_M, CURVATURE_RADIUS_M = 12.8e-3, 2e-3, 20e-3
BODY = HalfSpace(2e5, 0.5)
PLANE_STRAIN_PASCAL = BODY.youngs_modulus_pascal / (1.0 - BODY.poisson_ratio**2)
LOAD_NEWTON = 4.0 * PLANE_STRAIN_PASCAL * CONTACT_RADIUS_M**3 / (3.0 * CURVATURE_RADIUS_M)
PEAK_PASCAL = 1.5 * LOAD_NEWTON / (np.pi * CONTACT_RADIUS_M**2)
TOLERANCE = 1e-8


@dataclass(frozen=True)
class Program:
    """One way to solve the Hertz contact: what it prepares for a grid, and the pressure that it then finds."""

    name: str
    prepare: Callable[[int], Callable[[Floats], Floats]]


def with_press(count: int) -> Callable[[Floats], Floats]:
    compliance = SurfaceCompliance(BODY, (count, count), SIDE_M / count)
    return lambda profile: press(compliance, profile, load_newton=LOAD_NEWTON, tolerance=TOLERANCE).pressure_pascal


def with_aspher(precond: str) -> Callable[[int], Callable[[Floats], Floats]]:
    def prepare(count: int) -> Callable[[Floats], Floats]:
        solver = aspher.ContactSolver(grid_size=count, domain_size=SIDE_M, E_star=PLANE_STRAIN_PASCAL, backend="fft")
        mean_pascal = LOAD_NEWTON / SIDE_M**2
        return lambda profile: np.asarray(
            solver.solve(profile.ravel(), mean_pascal, tol=TOLERANCE, precond=precond).pressure
        )

    return prepare


def with_nested_aspher(count: int) -> Callable[[Floats], Floats]:
    return lambda profile: np.asarray(
        aspher.solve_nested(
            grid_size=count,
            gap=profile.ravel(),
            p_nominal=LOAD_NEWTON / SIDE_M**2,
            domain_size=SIDE_M,
            E_star=PLANE_STRAIN_PASCAL,
            coarsest=16,
            tol=TOLERANCE,
            backend="fft",
        ).pressure
    )


def with_tamaas(*, periodic: bool) -> Callable[[int], Callable[[Floats], Floats]]:
    def prepare(count: int) -> Callable[[Floats], Floats]:
        tamaas.set_log_level(tamaas.LogLevel.error)  # or it prints its iterations
        model = tamaas.Model(tamaas.model_type.basic_2d, [SIDE_M, SIDE_M], [count, count])
        model.E, model.nu = BODY.youngs_modulus_pascal, BODY.poisson_ratio
        if not periodic:
            tamaas.ModelFactory.registerNonPeriodic(model, "dcfft")

        def solve(profile: Floats) -> Floats:
            model.traction[...] = 0.0
            solver = tamaas.PolonskyKeerRey(model, -profile, TOLERANCE)
            if not periodic:
                solver.setIntegralOperator("dcfft")
            solver.solve(LOAD_NEWTON / SIDE_M**2)
            return np.array(model.traction)

        return solve

    return prepare


def programs() -> list[Program]:
    found = [Program("press", with_press)]
    if aspher is None:
        print("aspher is not installed")
    else:
        found += [
            Program("aspher solve, stencil", with_aspher("fourier")),
            Program("aspher solve, transform", with_aspher("fourier-fft")),
            Program("aspher solve_nested", with_nested_aspher),
        ]
    if tamaas is None:
        print("tamaas is not installed")
    else:
        found += [
            Program("tamaas, periodic", with_tamaas(periodic=True)),
            Program("tamaas, dcfft", with_tamaas(periodic=False)),
        ]
    return found


def compare(candidates: list[Program], count: int, rounds: int) -> None:
    """Print a line for each program: error, and time compared with that of `press`, the first."""
    pitch_m = SIDE_M / count
    profile = paraboloid((count, count), pitch_m, CURVATURE_RADIUS_M)
    ready = [program.prepare(count) for program in candidates]
    prepared_s = np.zeros((rounds, len(candidates)))
    whole_s = np.zeros_like(prepared_s)
    for turn in range(rounds):
        for place, program in enumerate(candidates):
            started = time.perf_counter()
            ready[place](profile)
            between = time.perf_counter()
            program.prepare(count)(profile)
            prepared_s[turn, place], whole_s[turn, place] = between - started, time.perf_counter() - between
    prepared_ms, whole_ms = np.median(prepared_s, axis=0) * 1e3, np.median(whole_s, axis=0) * 1e3
    least = np.sqrt(1.0 - (pitch_m / CONTACT_RADIUS_M) ** 2 / 2.0)  # of p / p0 at the pixels around the axis
    print(f"\nHertz, {count} x {count}")
    print(f"{'':24} {'p0 error':>9} {'solve ms':>9} {'press':>9} {'with set-up ms':>15} {'press':>9}")
    for place, program in enumerate(candidates):
        error = float(ready[place](profile).max()) / least / PEAK_PASCAL - 1.0
        print(
            f"{program.name:24} {error:9.1e} {prepared_ms[place]:9.2f} {prepared_ms[0] / prepared_ms[place]:8.2f}x"
            f" {whole_ms[place]:15.2f} {whole_ms[0] / whole_ms[place]:8.2f}x"
        )


def rough_profile(count: int) -> Floats:
    """Self-affine surface of Hurst exponent 0.8 within a rim."""
    waves = count * np.hypot(np.fft.rfftfreq(count), np.fft.fftfreq(count)[:, None])
    amplitude = np.where((waves >= 2) & (waves <= count / 4), np.maximum(waves, 1.0) ** -1.8, 0.0)
    noise = np.random.default_rng(1).standard_normal((count, count))
    profile = np.fft.irfft2(amplitude * np.fft.rfft2(noise), s=(count, count))
    profile *= 2e-5 / profile.std()
    profile[[0, -1]] = profile[:, [0, -1]] = np.inf
    return profile


def show_residuals(count: int) -> None:
    """Print the residual after each iteration on the finest grid."""
    shape, pitch_m = (count, count), SIDE_M / count
    compliance = SurfaceCompliance(BODY, shape, pitch_m)
    problems = {
        "Hertz": (paraboloid(shape, pitch_m, CURVATURE_RADIUS_M), LOAD_NEWTON),
        "punch": (flat_punch(shape, pitch_m, 4e-3), LOAD_NEWTON),
        "rough 1 %": (rough_profile(count), 0.01),
        "rough 60 %": (rough_profile(count), 1.0),
    }
    print(f"\nresidual against iterations on the finest grid, {count} x {count}")
    for name, (profile, load_newton) in problems.items():
        contact = press(compliance, profile, load_newton=load_newton, tolerance=1e-10)
        print(f"{name:10}  {' '.join(f'{residual:.0e}' for residual in contact.residuals)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("rounds", type=int, nargs="?", default=30, help="times each is timed (default: 30)")
    rounds: int = parser.parse_args().rounds
    candidates = programs()
    for count in (32, 128, 512):
        compare(candidates, count, rounds if count <= 128 else max(rounds // 6, 1))
    show_residuals(128)


if __name__ == "__main__":
    main()
