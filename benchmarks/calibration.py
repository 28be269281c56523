"""Prints how near a guided calibration of emulated plates comes to their true codes.

The plate file is off by up to 25 % in each K and 20 ppm in each f0. K errors are those of all sites and channels
against the true plate's, the largest and the rms. "stated" is the record's own: sensitivity_std for K, the largest of
the residuals for forces. Masses weigh 50, 200 and 500 g; holds are 1 s, with loading and unloading 60 s. Gates are of
10 ms (comb16: 20 ms), which cost less to count than the plates' own and change nothing else.

Without a fit of hysteresis and creep, sensitivity_std and residuals hold what the pace of the holds allows of creep:
on ideal sites that is noise. With touches that scatter by 1.5 %, K of a site is known from few touches, and the largest
of 64 errors is some 2.5 times the rms.
"""

import sys
import tempfile
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[1] / "tests" / "calibration"))

from emulated_loads import (
    COMB_NOMINAL,
    COMB_TRUE,
    IDEAL,
    NOMINAL,
    TRUE,
    Loads,
    Touches,
    comb_frames,
    fitted,
    frames,
    lead,
)

from resonator_daemon.calibration.load_procedure import LoadProcedure
from resonator_daemon.calibration.outcome import make_record
from resonator_daemon.calibration.plate_file import Record
from resonator_daemon.calibration.steps import LoadRequest, plan_steps

USUAL = LoadRequest(hold_s=1.0)
SCATTERING = f"{IDEAL}sensitivity_scatter = 0.015\n"
CREEPING = "hysteresis_fraction = 0.01\ncreep_fraction = 0.005\n"
FOUR_SITES = (7, 1, 12, 13)


@dataclass(frozen=True)
class Calibrated:
    """A record, and the relative errors of its K (sites, channels)."""

    record: Record
    error: NDArray[np.float64]
    doubtful: bool
    response_std: tuple[float, float]  # newton and relative, of hysteresis and creep as fitted


def calibrated(
    wanted: LoadRequest, physics: str, masses: dict[float, float] | None = None, *, comb: bool = False
) -> Calibrated:
    """Calibrate an emulated plate, quartz16 or comb16."""
    nominal, true = (COMB_NOMINAL, COMB_TRUE) if comb else (NOMINAL, TRUE)
    steps = plan_steps(wanted, nominal)
    touches = Touches(physics=physics)
    touches.follow(steps, masses)
    procedure = LoadProcedure(nominal, steps, 60.0)
    loads = Loads(nominal, true) if comb else None
    with tempfile.TemporaryDirectory() as folder:
        counted = (comb_frames if comb else frames)(true, touches, Path(folder))
        for _ in lead(procedure, nominal, counted, loads):
            pass
    if not procedure.done:
        raise RuntimeError("the loads ended before the calibration")
    outcome = fitted(procedure, wanted, nominal, loads)
    record = make_record(
        nominal,
        wanted,
        procedure,
        outcome,
        calibration_id="",
        unit="",
        today=date(2026, 1, 1),
        valid_days=1,
        untouched_hz=None if loads is None else loads.untouched_hz,
    )
    rows = [nominal.site_ids.tolist().index(site.site_id) for site in record.sites]
    error = np.array([site.sensitivity for site in record.sites]) / true.tones.sensitivity[rows] - 1
    found = outcome.fit.response
    stds = (0.0, 0.0) if found is None else (found.hysteresis_std_newton, found.creep_fraction_std)
    return Calibrated(record, error, bool(outcome.doubtful), stds)


def main() -> None:
    heads = f"{'largest':>9}{'rms':>9}{'stated':>8}{'residual':>11}{'eps':>8}{'doubt':>7}"
    print(f"{'plate and masses':<47}{heads}  response")
    heavy = {mass: 1.01 * mass for mass in USUAL.masses_kg}
    response = replace(USUAL, sites=FOUR_SITES, response=True)
    for name, wanted, physics, masses, comb in (
        ("ideal, masses exact, stated to 0.1 %", USUAL, IDEAL, None, False),
        ("ideal, all masses 1 % heavy, stated so", replace(USUAL, mass_std=0.01), IDEAL, heavy, False),
        ("ideal, 1.5 % scatter from touch to touch", replace(USUAL, repeats=2), SCATTERING, None, False),
        ("hysteresis and creep, fitted", response, f"{IDEAL}{CREEPING}", None, False),
        ("hysteresis and creep, not fitted, from zero", USUAL, f"{IDEAL}{CREEPING}", None, False),
        ("everything at the emulator's defaults, fitted", response, "", None, False),
        ("comb16, ideal", USUAL, IDEAL, None, True),
        ("comb16, hysteresis and creep, fitted", response, f"{IDEAL}{CREEPING}", None, True),
        ("comb16, everything at the defaults, fitted", response, "", None, True),
    ):
        print_row(name, calibrated(wanted, physics, masses, comb=comb))
    print_drawn_masses()


def print_row(name: str, found: Calibrated) -> None:
    record, response = found.record, found.record.response
    told = "-"
    if response is not None:
        hysteresis = f"{1e3 * response.hysteresis_newton:.1f} +- {1e3 * found.response_std[0]:.1f} mN"
        creep = f"{100 * response.creep_fraction:.3f} +- {100 * found.response_std[1]:.3f} %"
        told = f"{hysteresis}, {creep} in {response.creep_time_s:.1f} s"
    if record.coupling:
        told += f"; coupling off by {coupling_error(record):.1e} at most"
    worst = max(site.residual_newton for site in record.sites)
    print(
        f"{name:<47}{100 * np.abs(found.error).max():>7.3f} %{100 * np.sqrt(np.mean(found.error**2)):>7.3f} %"
        f"{100 * record.sensitivity_std:>6.2f} %{1e3 * worst:>8.2f} mN{100 * record.model_error:>6.2f} %"
        f"{'yes' if found.doubtful else 'no':>7}  {told}",
        flush=True,
    )


def coupling_error(record: Record) -> float:
    """Largest departure from the share below a point load, of those whose sensitivity was calibrated."""
    place = {site.id: np.array(site.position_mm) for site in COMB_TRUE.sites}
    loaded = {site.site_id for site in record.sites}
    squares = (((place[felt.pressed] - place[felt.measured]) ** 2).sum() for felt in record.coupling)
    shares = [(1 + square / 2.5**2) ** -1.5 for square in squares]
    pairs = zip(record.coupling, shares, strict=True)
    return max(abs(felt.ratio - share) for felt, share in pairs if felt.measured in loaded)


def print_drawn_masses() -> None:
    """Masses off by 1 % each, drawn anew for each of 40 calibrations of one site; exact masses else."""
    random = np.random.default_rng(3)
    wanted = replace(USUAL, sites=(7,), mass_std=0.01)
    results = []
    for _ in range(40):
        drawn = {mass: mass * (1 + 0.01 * random.standard_normal()) for mass in wanted.masses_kg}
        found = calibrated(wanted, IDEAL, drawn)
        results.append((float(np.sqrt(np.mean(found.error**2))), found.record.sensitivity_std))
    error, stated = np.sqrt(np.mean(np.square(results), axis=0))
    print(f"{'40 draws of masses off by 1 % each':<56}{100 * error:>7.3f} %{100 * stated:>6.2f} %")


if __name__ == "__main__":
    main()
