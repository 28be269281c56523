"""Residual against iterations for known and unknown regions, compared with the iteration that the paper prints.

Run it with `python benchmarks/elastic_convergence.py [--picture FILE]`.

All on a surface of 64 x 64 pixels that repeats, nu = 0.3. The residual is that of `minimise`, computed alike for all.
"Paper" is the alternating iteration of its section 2.3: tractions give displacements, the known ones are put in, these
give tractions, the known ones are put in; in case 4 the region is estimated and the load restored in each step. The
paper has no proof that it converges: an error grows where (T^-1)_ii T_ii, i the pixels held, has an eigenvalue above 2.
"Half steps" go half of each step.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import fft

from resonator_daemon.arrays import Bools, Complexes, Floats
from resonator_daemon.elastic import HalfSpace, SpectralGrid
from resonator_daemon.elastic.constrained import LinearMap, Prescribed, minimise
from resonator_daemon.elastic.contact import press
from resonator_daemon.elastic.influence import RoughStiffness, SurfaceCompliance
from resonator_daemon.elastic.mixed import MixedBoundary

COUNT, TOLERANCE, ITERATIONS = 64, 1e-8, 100
BODY = HalfSpace(2.6, 0.3)  # shear modulus 1, pitch 1
GRID = SpectralGrid((COUNT, COUNT), 1.0)
AXIS = np.arange(COUNT) - (COUNT - 1) / 2
RADIUS = np.hypot(AXIS, AXIS[:, None])
PICTURE = Path(__file__).parents[1] / "docs/figures/convergence.svg"
COLOURS = {"minimise, no preconditioner": "C1", "paper": "C2", "paper, half steps": "C3"}  # C0: ours
SHOWN = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True)
class Curve:
    """Residuals of one method on one problem, one an iteration."""

    problem: str
    method: str
    residuals: list[float]


def applied(matrix: Complexes) -> LinearMap:
    """Map of images (3, ny, nx) by a matrix at each frequency."""
    return lambda images: fft.irfft2(np.einsum("yxij,jyx->iyx", matrix, fft.rfft2(images)), s=GRID.shape)


def known_region(problem: str, held: Bools) -> Iterator[Curve]:
    """Case 3: a disc comes down by 1, held where `held` (3, ny, nx) is true and free of traction elsewhere.

    The isolated rule for the mean, so that it too can go from tractions to displacements and back.
    """
    by_traction = MixedBoundary(BODY, GRID, ("f_x", "f_y", "f_z"), zero="isolated")
    by_displacement = MixedBoundary(BODY, GRID, ("u_x", "u_y", "u_z"), zero="isolated")
    compliance = applied(by_traction.transfer_matrix("displacement", 0.0))
    stiffness = applied(by_displacement.transfer_matrix("traction", 0.0))
    zeros = np.zeros((3, COUNT, COUNT))
    target = np.where(held, np.array([0.0, 0.0, 1.0])[:, None, None], 0.0)
    one_pixel = zeros.copy()
    one_pixel[2, 0, 0] = 1.0
    own = float(compliance(one_pixel)[2, 0, 0])

    preconditioners: dict[str, LinearMap] = {
        "minimise": RoughStiffness(GRID.shape),
        "minimise, no preconditioner": lambda images: images,
    }
    for method, precondition in preconditioners.items():
        minimum = minimise(
            compliance, target, Prescribed(zeros, held), zeros, self_compliance=own, precondition=precondition
        )
        yield Curve(problem, method, list(minimum.residuals))

    def step(f: Floats) -> tuple[Floats, float]:
        u = compliance(f)
        missed = np.where(held, target - u, 0.0)
        return np.where(held, stiffness(u + missed), 0.0), float(np.linalg.norm(missed) / own / np.linalg.norm(f))

    yield from by_paper(problem, step, target)


def unknown_region(problem: str, profile: Floats, load: float) -> Iterator[Curve]:
    """Case 4: an object with a load, without friction."""
    compliance = SurfaceCompliance(BODY, GRID.shape, GRID.pitch_m, periodic=True)
    minimum = press(compliance, profile, load_newton=load, tolerance=TOLERANCE)
    yield Curve(problem, "press, its finest grid", list(minimum.residuals))

    own = compliance.of_own_load
    wavenumber = np.hypot(GRID.omega_x, GRID.omega_y)
    stiffness = BODY.shear_modulus_pascal / (1.0 - BODY.poisson_ratio) * wavenumber
    gentle = np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0.0)

    def filtered(response: Floats, image: Floats) -> Floats:
        return np.asarray(fft.irfft2(response * fft.rfft2(image), s=GRID.shape), np.float64)

    def step(f: Floats) -> tuple[Floats, float]:
        """One step of the paper's iteration; the region is where tractions outweigh the gap."""
        gap = filtered(gentle, f) + profile
        approach = np.average(gap, weights=f)
        pushing = f + (approach - gap) / own
        touching = pushing > 0.0
        u = np.where(touching, approach, gap) - profile
        pressure = np.where(touching, np.maximum(filtered(stiffness, u) + load / profile.size, 0.0), 0.0)
        return pressure * load / pressure.sum(), float(np.linalg.norm(f - np.maximum(pushing, 0.0)) / np.linalg.norm(f))

    yield from by_paper(problem, step, np.full(profile.shape, load / profile.size))


def by_paper(problem: str, step: Callable[[Floats], tuple[Floats, float]], start: Floats) -> Iterator[Curve]:
    """Both ways to go the paper's steps; `step` gives the next tractions and the residual of the present ones."""
    for method, share in {"paper": 1.0, "paper, half steps": 0.5}.items():
        tractions, residuals = start, []
        for _ in range(ITERATIONS):
            aim, residual = step(tractions)
            residuals.append(residual)
            if residual <= TOLERANCE:
                break
            tractions = tractions + share * (aim - tractions)
        yield Curve(problem, method, residuals)


def curves() -> Iterator[Curve]:
    disc = RADIUS <= COUNT / 4
    yield from known_region("smooth flat punch", disc & np.array([False, False, True])[:, None, None])
    yield from known_region("bonded flat punch", disc & np.ones((3, 1, 1), np.bool_))
    yield from unknown_region("paraboloid", RADIUS**2 / COUNT, load=600.0)
    spectrum = fft.rfft2(np.random.default_rng(1).normal(size=GRID.shape))
    frequency = np.hypot(GRID.omega_x, GRID.omega_y) + 2.0 * np.pi / COUNT
    yield from unknown_region("rough surface", fft.irfft2(spectrum * frequency**-1.8, s=GRID.shape), load=2000.0)


def print_table(found: list[Curve]) -> None:
    print(f"{'':20}{'':29}{'iterations':>10}" + "".join(f"{f'at {n}':>9}" for n in SHOWN))
    for curve in found:
        reached = curve.residuals[-1] <= TOLERANCE
        count = str(len(curve.residuals)) if reached else f"> {len(curve.residuals)}"
        row = "".join(f"{curve.residuals[n - 1]:9.0e}" if n <= len(curve.residuals) else f"{'':9}" for n in SHOWN)
        print(f"{curve.problem:20}{curve.method:29}{count:>10}{row}")


def draw(found: list[Curve], path: Path) -> None:
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        print("no picture: matplotlib not installed")
        return
    problems = list(dict.fromkeys(curve.problem for curve in found))
    with rc_context({"svg.hashsalt": "convergence", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(9.0, 6.0), layout="constrained")
        for axes, problem in zip(figure.subplots(2, 2, sharey=True).flat, problems, strict=True):
            for curve in found:
                if curve.problem == problem:
                    iterations = range(1, len(curve.residuals) + 1)
                    colour = COLOURS.get(curve.method, "C0")
                    residuals = 10.0 ** np.round(np.log10(curve.residuals), 2)  # the same drawing on any machine
                    axes.semilogy(iterations, residuals, color=colour, label=curve.method)
            axes.set(
                title=problem, xlabel="iteration", xscale="log", xlim=(1, ITERATIONS), ylim=(TOLERANCE / 10, 100.0)
            )
            axes.axhline(TOLERANCE, color="grey", linewidth=0.5)
            axes.legend(loc="lower left", frameon=False)
        figure.supylabel("residual, relative to the tractions")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None})
    print(f"picture: {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--picture", type=Path, default=PICTURE, metavar="FILE")
    picture: Path = parser.parse_args().picture
    found = list(curves())
    print_table(found)
    draw(found, picture)


if __name__ == "__main__":
    main()
