"""Partial slip and its coupling with pressure: error and time, compared with tamaas where it installs.

Run it with `python benchmarks/elastic_friction.py [ROUNDS]`. Times are medians over interleaved
rounds, with all preparation: each solver knows just the object and its loads. The case is a rigid paraboloid, contact
radius 2.5 mm on a square of 12.8 mm, coefficient of friction 0.5, shear load 0.875 of what friction holds, at 30
degrees.

nu = 0.5 is Cattaneo's and Mindlin's case, c/a = 0.5: errors are those of the shear along the load, relative, and the
largest shear across it, relative to the greatest pressure (not 0 in truth). tamaas is periodic. Its residuals count
with its own displacements, and are those of `FrictionalContact`. Its solvers' tolerances do not tell when they are
there, so that their iterations are given: 1000 are the default, from 3000 the answer of Condat is settled to 1e-3.

nu = 0.3 is solved on a periodic body by both. They differ in the odd terms at Nyquist frequencies, which tamaas keeps.
That is to be judged against what discretisation does: how far the answer moves on a grid twice as fine.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.elastic.constrained import Friction
from resonator_daemon.elastic.friction import FrictionalContact
from resonator_daemon.elastic.influence import SurfaceCompliance
from simulators.contact import pixel_tractions

try:
    import tamaas
except ImportError:
    tamaas = None


SIDE_M, CONTACT_RADIUS_M, CURVATURE_RADIUS_M = 12.8e-3, 2.5e-3, 20e-3
YOUNGS_PASCAL, FRICTION_COEFFICIENT, SHARE = 2e5, 0.5, 0.875
ALONG = np.array([np.cos(np.pi / 6.0), np.sin(np.pi / 6.0)])
ACROSS = np.array([-ALONG[1], ALONG[0]])
_HELD = 1e-4  # share of the limit of friction by which shear must stay below it to count as sticking


@dataclass(frozen=True)
class Case:
    """The paraboloid on a grid."""

    poisson_ratio: float
    count: int

    @property
    def pitch_m(self) -> float:
        return SIDE_M / self.count

    @property
    def profile_m(self) -> Floats:
        axis = (np.arange(self.count) - (self.count - 1) / 2.0) * self.pitch_m
        return np.asarray((axis**2 + axis[:, None] ** 2) / (2.0 * CURVATURE_RADIUS_M))

    @property
    def load_newton(self) -> Floats:
        stiffness = YOUNGS_PASCAL / (1.0 - self.poisson_ratio**2)
        normal = 4.0 * stiffness * CONTACT_RADIUS_M**3 / (3.0 * CURVATURE_RADIUS_M)
        return np.array([*(SHARE * FRICTION_COEFFICIENT * normal * ALONG), normal])

    def compliance(self, *, periodic: bool) -> SurfaceCompliance:
        half_space = HalfSpace(YOUNGS_PASCAL, self.poisson_ratio)
        return SurfaceCompliance(half_space, (self.count, self.count), self.pitch_m, periodic)


@dataclass(frozen=True)
class Answer:
    """Tractions and residual of a solver."""

    traction_pascal: Floats
    residual: float


def ours(case: Case, *, periodic: bool, tolerance: float) -> Answer:
    compliance = case.compliance(periodic=periodic)
    contact = FrictionalContact(compliance, case.profile_m, FRICTION_COEFFICIENT, tolerance)
    state = contact.step(contact.apart, load_newton=case.load_newton)
    return Answer(state.traction_pascal, state.residuals[-1])


def of_tamaas(solver: str, case: Case, iterations: int) -> Answer:
    """Solve in millimetres and Young's moduli: in SI units the steps of the solvers run away."""
    model = tamaas.Model(tamaas.model_type.surface_2d, [SIDE_M * 1e3] * 2, [case.count] * 2)
    model.E, model.nu = 1.0, case.poisson_ratio
    method = getattr(tamaas, solver)(model, -case.profile_m * 1e3, 1e-12, FRICTION_COEFFICIENT)
    method.max_iter, method.dump_freq = iterations, iterations + 1
    method.solve(list(case.load_newton / (YOUNGS_PASCAL * SIDE_M**2)))
    traction = np.array(model.traction).transpose(2, 1, 0) * YOUNGS_PASCAL
    displacement_m = np.array(model.displacement).transpose(2, 1, 0) * 1e-3
    return Answer(traction, residual(case, traction, displacement_m))


def residual(case: Case, traction: Floats, displacement_m: Floats) -> float:
    """Residual of `FrictionalContact`, the shift taken from where the surface sticks."""
    limit = FRICTION_COEFFICIENT * traction[2]
    sticks = np.hypot(*traction[:2]) < limit * (1.0 - _HELD)
    slack = -displacement_m - np.stack([np.zeros_like(limit)] * 2 + [case.profile_m])
    slack -= slack[:, sticks].mean(axis=1)[:, None, None]
    aim = traction + slack / case.compliance(periodic=True).of_own_load
    miss = np.concatenate([Friction(limit).nearest(aim[:2]), np.maximum(aim[2:], 0.0)]) - traction
    return float(np.linalg.norm(miss) / np.linalg.norm(traction))


def measure(solvers: dict[str, Callable[[], Answer]], rounds: int) -> tuple[dict[str, Answer], dict[str, float]]:
    """Answers, and medians of the seconds they took."""
    answers: dict[str, Answer] = {}
    spent_s: dict[str, list[float]] = {name: [] for name in solvers}
    for _ in range(rounds):
        for name, solve in solvers.items():
            started = time.perf_counter()
            answers[name] = solve()
            spent_s[name].append(time.perf_counter() - started)
    return answers, {name: float(np.median(times)) for name, times in spent_s.items()}


def partial_slip(count: int, rounds: int) -> None:
    case = Case(0.5, count)
    solvers: dict[str, Callable[[], Answer]] = {
        "ours, to 1e-6": partial(ours, case, periodic=False, tolerance=1e-6),
        "ours, to 1e-8": partial(ours, case, periodic=False, tolerance=1e-8),
    }
    if tamaas is not None:
        for solver, iterations in [("Condat", 1000), ("Condat", 3000), ("PolonskyKeerTan", 300)]:
            solvers[f"{solver}, {iterations}"] = partial(of_tamaas, solver, case, iterations)
    answers, median_s = measure(solvers, rounds)
    at_1_newton_m = CONTACT_RADIUS_M / np.cbrt(case.load_newton[2])
    shape = (count, count)
    truth = pixel_tractions(case.load_newton, (0.0, 0.0), at_1_newton_m, FRICTION_COEFFICIENT, shape, case.pitch_m)
    true_shear = np.einsum("i,iyx->yx", ALONG, truth[:2])
    for name, answer in answers.items():
        along, across = (np.einsum("i,iyx->yx", way, answer.traction_pascal[:2]) for way in (ALONG, ACROSS))
        limit = FRICTION_COEFFICIENT * answer.traction_pascal[2]
        sticks = np.hypot(along, across) < limit * (1.0 - _HELD)
        print(
            f"{count:4}  {name:20} {np.linalg.norm(along - true_shear) / np.linalg.norm(true_shear):10.3f}"
            f" {np.abs(across).max() / truth[2].max():10.3f} {np.sqrt(sticks.sum() / (limit > 0.0).sum()):6.3f}"
            f" {answer.residual:9.1e} {median_s[name] * 1e3:9.1f} {median_s['ours, to 1e-6'] / median_s[name]:8.3f}"
        )


def coupled(counts: Sequence[int], rounds: int) -> None:
    """Compare on one grid, and with the means over the pixels of the next coarser one."""
    last: dict[str, Answer] = {}
    for count in counts:
        case = Case(0.3, count)
        solvers: dict[str, Callable[[], Answer]] = {"ours": partial(ours, case, periodic=True, tolerance=1e-8)}
        if tamaas is not None:
            solvers["tamaas"] = partial(of_tamaas, "PolonskyKeerTan", case, 600)
        answers, median_s = measure(solvers, rounds)
        for name, answer in answers.items():
            found = answer.traction_pascal
            size = np.linalg.norm(found)
            apart = f"{np.linalg.norm(found - answers['ours'].traction_pascal) / size:12.1e}" if name != "ours" else ""
            moved = ""
            if name in last:
                before = last[name].traction_pascal
                coarse = found.reshape(3, count // 2, 2, count // 2, 2).mean(axis=(2, 4))
                moved = f"{np.linalg.norm(coarse - before) / np.linalg.norm(before):12.1e}"
            sticks = np.hypot(*found[:2]) < FRICTION_COEFFICIENT * found[2] * (1.0 - _HELD)
            print(
                f"{count:4}  {name:8} {answer.residual:9.1e} {sticks.sum():7} {(found[2] > 0.0).sum():8} {apart:>12}"
                f" {moved:>12} {median_s[name] * 1e3:9.1f}"
            )
        last = answers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("rounds", type=int, nargs="?", default=5, help="times each is timed (default: 5)")
    rounds: int = parser.parse_args().rounds
    if tamaas is None:
        print("tamaas: not installed")
    else:
        tamaas.set_log_level(tamaas.LogLevel.error)
    print("partial slip, nu = 0.5; ratio: time of ours to 1e-6 over that of the line")
    print(f"{'n':>4}  {'solver':20} {'err along':>10} {'max across':>10}", end=" ")
    print(f"{'c/a':>6} {'residual':>9} {'ms':>9} {'ratio':>8}")
    for count in (32, 64, 128):
        partial_slip(count, max(rounds * 32 // count, 1))
    print("coupled, nu = 0.3, periodic; differences relative")
    print(f"{'n':>4}  {'solver':8} {'residual':>9} {'stick':>7} {'contact':>8}", end=" ")
    print(f"{'from ours':>12} {'from n / 2':>12} {'ms':>9}")
    coupled((32, 64, 128), max(rounds // 3, 1))


if __name__ == "__main__":
    main()
