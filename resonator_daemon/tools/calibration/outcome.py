"""History of the loads, the fit of what was captured, its doubts, and the record for the plate file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.forces.calibration_fit import CalibrationFit, fit_calibration, fit_temperature
from resonator_daemon.estimate.forces.loading_fit import RESPONSE_DEFAULT
from resonator_daemon.estimate.forces.loadings import Readings, Steps
from resonator_daemon.estimate.forces.site_response import SiteResponse
from resonator_daemon.tools.calibration.coupling import compare_with_width, find_coupling
from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.tools.calibration.load_readings import site_codes
from resonator_daemon.tools.calibration.plate_file import Record, ResponseRecord, SiteRecord
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY, LoadRequest, Step

KELVIN_MARGIN: Final = 5.0  # on either side of the temperatures of a calibration
MODEL_ERROR_MIN: Final = 1e-3  # fewer loads than thousands cannot vouch for less
MODEL_ERROR_KNOWN: Final = 0.3  # relative standard deviation up to which the scatter found is taken
BAD_SHARE: Final = 0.005  # of the load: what a bad loading is off by, at least
BAD_NEWTON: Final = 2e-3
USUAL_CUT: Final = np.array([0.0, -0.5e-9, 1.08e-10])  # of AT quartz: a depends on the angle of cut, b and c little
USUAL_CUT_STD: Final = np.array([1e-6, 1e-9, 1e-11])
SMALLEST_MASS_STD: Final = 1e-9  # stands for exact masses

PACE_SIGMAS: Final = 2.0  # of the pace, so that holds too short to show creep do not rule it out
CARRIED_ON_S: Final = math.exp(RESPONSE_DEFAULT[2])  # creep that begins at some pace and dies out goes on for its time

COMMON_MODE_STD: Final = 1e-9  # of the pilot's mean over some tenths of a second


class LoadChange(NamedTuple):
    """A load that comes to a site, or goes: then `loading` is None."""

    site: int
    since_s: float
    kelvin: float
    loading: Loading | None


def load_history(procedure: LoadProcedure, loadings: Sequence[Loading]) -> list[LoadChange]:
    """Return the changes that loadings were, in their order."""
    changes = []
    for loading in sorted(loadings, key=lambda loading: loading.since_s):
        kelvin = loading.step.kelvin
        changes.append(LoadChange(loading.site, loading.since_s, kelvin, loading))
        if (released_s := _released_s(procedure, loading)) is not None:
            changes.append(LoadChange(loading.site, released_s, kelvin, None))
    return changes


def steps_of(changes: Sequence[LoadChange], request: LoadRequest) -> Steps:
    """Return the changes as the steps of a fit."""
    masses_kg = np.array(request.masses_kg)
    lying_kg = [change.loading.step.mass_kg if change.loading else math.nan for change in changes]
    kelvin = [change.kelvin if request.kelvin is not None else math.nan for change in changes]
    return Steps(
        np.array([change.site for change in changes]),
        np.array([change.since_s for change in changes]),
        masses_kg == np.array(lying_kg)[:, None],
        np.full(len(changes), COMMON_MODE_STD),
        np.array(kelvin),
    )


def readings_of(changes: Sequence[LoadChange], procedure: LoadProcedure) -> Readings:
    """Return the readings of all loads that were captured."""
    captured = [(row, change.loading) for row, change in enumerate(changes) if change.loading is not None]
    return Readings(
        np.concatenate([np.full(len(load.times_s), row) for row, load in captured]),
        np.concatenate([load.times_s for _, load in captured]),
        np.concatenate([load.without_common_mode(procedure.untouched) for _, load in captured]),
        np.concatenate([load.std for _, load in captured]),
        np.concatenate([np.full(len(load.times_s), load.oscillator_std) for _, load in captured]),
    )


def _released_s(procedure: LoadProcedure, loading: Loading) -> float | None:
    """When a load was taken away; None where another followed on the same site."""
    after = [time_s for time_s in procedure.released_s if time_s > loading.times_s[-1]]
    following = [other.since_s for other in procedure.loadings.values() if other.since_s > loading.since_s]
    if not after or (following and min(following) < after[0]):
        return None
    return after[0]


@dataclass(frozen=True)
class Outcome:
    """A fit of all loads, with the steps that it doubts."""

    fit: CalibrationFit
    doubtful: tuple[Step, ...]
    swapped: tuple[Step, Step] | None
    residual_newton: dict[int, float]  # by number of the step
    creep_share: float  # of a force, by which sites would creep further; NaN where no load came from zero

    @property
    def creep_std(self) -> float:
        """What creep that was not fitted may add, relative."""
        return 0.0 if self.fit.response is not None else self.creep_share

    @property
    def loads_std(self) -> Floats:
        """By how much each site's K (s,) is unknown for its loads and masses, relative."""
        std: Floats = np.sqrt(np.mean((self.fit.sensitivity_std / self.fit.sensitivity) ** 2, axis=1))
        return std

    @property
    def sensitivity_std(self) -> Floats:
        """By how much each site's K (s,) is unknown in all, relative."""
        return np.hypot(self.loads_std, self.creep_std)


def fit_loadings(
    plate: Plate,
    request: LoadRequest,
    procedure: LoadProcedure,
    loadings: Sequence[Loading],
    *,
    with_response: bool,
    untouched_hz: Floats | None = None,
) -> Outcome:
    """Fit loads of any of the sites, those of a temperature sweep aside.

    `untouched_hz` (sites, 4) are the frequencies by which shifts go, where the untouched plate was measured.
    """
    used = [loading for loading in loadings if not loading.step.at_temperature]
    codes = site_codes(plate)
    masses_kg = np.array(request.masses_kg)
    changes = load_history(procedure, used)
    fit = fit_calibration(
        codes.f0_hz if untouched_hz is None else untouched_hz,
        codes.sensitivity,
        masses_kg * STANDARD_GRAVITY,
        np.full(len(masses_kg), max(request.mass_std, SMALLEST_MASS_STD)),
        steps_of(changes, request),
        readings_of(changes, procedure),
        with_response=with_response,
    )

    def step(row: int) -> Step:
        load = changes[row].loading
        if load is None:
            raise ValueError(f"row {row} of the fit is no load")
        return load.step

    rows = [(row, change.loading.step.number) for row, change in enumerate(changes) if change.loading is not None]
    residual_newton = {number: float(fit.residual_newton[row]) for row, number in rows}
    doubtful = [step(row) for row in fit.doubtful_steps]
    return Outcome(
        fit,
        # What is doubtful by so little is left out of the fit, and not worth another load.
        tuple(bad for bad in doubtful if abs(residual_newton[bad.number]) > BAD_NEWTON + BAD_SHARE * bad.force_newton),
        None if fit.swapped_steps is None else (step(fit.swapped_steps[0]), step(fit.swapped_steps[1])),
        residual_newton,
        creep_share(procedure, [load for load in used if not load.step.continues], fit),
    )


def make_record(
    plate: Plate,
    request: LoadRequest,
    procedure: LoadProcedure,
    outcome: Outcome,
    *,
    calibration_id: str,
    unit: str,
    today: date,
    valid_days: int,
    untouched_hz: Floats | None = None,
) -> Record:
    """Return what goes into the plate file; `untouched_hz` (sites, 4) where the untouched plate gave f0."""
    fit = outcome.fit
    codes = site_codes(plate)
    kelvin = plate.thermal.reference_kelvin if request.kelvin is None else request.kelvin
    found = _fit_temperature(plate, request, procedure, fit, kelvin)
    coefficients = codes.temperature_coefficients.copy()
    if found is not None:
        coefficients[fit.site] = found
    held_at = 1 + _temperature_shift(coefficients, kelvin - plate.thermal.reference_kelvin)[:, None]
    f0_hz = (codes.f0_hz if untouched_hz is None else untouched_hz) / held_at
    if untouched_hz is None:
        f0_hz[fit.site] = fit.f0_hz / held_at[fit.site]
    sensitivity = codes.sensitivity.copy()
    sensitivity[fit.site] = fit.sensitivity
    sites = []
    for row, site in enumerate(fit.site.tolist()):
        sites.append(
            SiteRecord(
                int(plate.site_ids[site]),
                tuple(f0_hz[site].tolist()),
                tuple(fit.sensitivity[row].tolist()),
                math.hypot(fit.site_residual_newton[row], outcome.creep_std * fit.force_range_newton[1]),
                None if found is None else tuple(found[row].tolist()),
            )
        )
    kelvins = [kelvin, *request.temperatures_kelvin]
    return Record(
        id=calibration_id,
        date=today,
        unit=unit,
        temperature_kelvin=kelvin,
        model_error=_model_error(plate, fit),
        sensitivity_std=min(0.5, math.sqrt(np.mean(outcome.sensitivity_std**2))),
        force_newton=(0.0, fit.force_range_newton[1]),
        kelvin=(min(kelvins) - KELVIN_MARGIN, max(kelvins) + KELVIN_MARGIN),
        expiry=today + timedelta(days=valid_days),
        sites=tuple(sites),
        response=None if fit.response is None else _response(fit.response),
        untouched_hz={} if untouched_hz is None else dict(zip(plate.site_ids.tolist(), f0_hz.tolist(), strict=True)),
        coupling=()
        if untouched_hz is None
        else find_coupling(plate, procedure, _loads(procedure, outcome), sensitivity),
    )


def notes(plate: Plate, request: LoadRequest, outcome: Outcome, record: Record) -> list[str]:
    """Return sentences on what the record does not hold or holds with less weight."""
    loaded = {site.site_id for site in record.sites}
    found = []
    if kept := [str(site_id) for site_id in plate.site_ids.tolist() if site_id not in loaded]:
        values = "sensitivities" if record.untouched_hz else "values"
        found.append(f"not loaded, {values} kept: sites {', '.join(kept)}")
    if not record.untouched_hz and np.isnan(outcome.fit.f0_std).any():
        found.append("one mass alone does not determine f0: it was kept where a site had no other")
    if len(request.masses_kg) * request.repeats < 3:
        found.append("two loads or fewer of a site always fit: their residuals mean nothing")
    if record.model_error != outcome.fit.model_error:
        found.append(
            f"model_error {record.model_error:.3g} stays: the loads are too few, or too good, to determine another"
        )
    if record.response is None:
        found.append(
            f"hysteresis and creep were not fitted (--response): at the pace of the holds sites may creep by "
            f"{100 * outcome.creep_share:.2g} % more, which is in sensitivity_std and residuals; loads from zero do "
            "not show hysteresis, and no error of this result includes it"
        )
    if sentence := compare_with_width(plate, record.coupling):
        found.append(sentence)
    if request.kelvin is None:
        found.append(f"temperature not given (--kelvin): taken as {record.temperature_kelvin:g} K")
    return found


def _fit_temperature(
    plate: Plate, request: LoadRequest, procedure: LoadProcedure, fit: CalibrationFit, kelvin: float
) -> Floats | None:
    """Coefficients (s, 3) from the heaviest mass at each temperature; None where there was no sweep."""
    if not request.temperatures_kelvin:
        return None
    kelvins = np.array([kelvin, *request.temperatures_kelvin])
    shift = np.empty((len(kelvins), len(fit.site)))
    for column, site in enumerate(fit.site.tolist()):
        site_id = int(plate.site_ids[site])
        for row, warmth in enumerate(kelvins):
            loads = [
                load
                for load in procedure.loadings.values()
                if (load.step.site_id, load.step.kelvin, load.step.mass_kg) == (site_id, warmth, request.masses_kg[-1])
            ]
            shift[row, column] = np.mean([load.without_common_mode(procedure.untouched).mean() for load in loads])
    touch = _model_error(plate, fit) * np.abs(fit.sensitivity).mean(axis=1) * request.masses_kg[-1] * STANDARD_GRAVITY
    # A load's scatter is independent from channel to channel.
    std = np.hypot(COMMON_MODE_STD, touch / math.sqrt(fit.sensitivity.shape[1]))
    found = fit_temperature(kelvins, shift, std, USUAL_CUT, USUAL_CUT_STD, plate.thermal.reference_kelvin)
    return found.coefficient


def _temperature_shift(coefficients: Floats, kelvin: float) -> Floats:
    """Relative shift (m,) at a distance from the reference temperature; 0 where the plate file does not have it."""
    shift: Floats = np.nan_to_num(coefficients) @ kelvin ** np.arange(1, 4)
    return shift


def _loads(procedure: LoadProcedure, outcome: Outcome) -> list[Loading]:
    """Return the loads that a fit used, but for slight doubts."""
    doubtful = {step.number for step in outcome.doubtful}
    loads = procedure.loadings.values()
    return [load for load in loads if not load.step.at_temperature and load.step.number not in doubtful]


def _model_error(plate: Plate, fit: CalibrationFit) -> float:
    if not fit.model_error_std < MODEL_ERROR_KNOWN * fit.model_error:
        return plate.calibration.model_error
    return min(max(fit.model_error, MODEL_ERROR_MIN), 0.5)


def _response(response: SiteResponse) -> ResponseRecord:
    spread = max(
        response.hysteresis_std_newton / max(response.hysteresis_newton, 1e-9),
        response.creep_fraction_std / max(response.creep_fraction, 1e-9),
        response.creep_time_std_s / response.creep_time_s,
    )
    return ResponseRecord(
        response.hysteresis_newton, response.creep_fraction, response.creep_time_s, min(max(spread, 0.01), 1.0)
    )


def creep_share(procedure: LoadProcedure, loadings: Sequence[Loading], fit: CalibrationFit) -> float:
    """Share of a force by which sites may creep on, at the pace of the holds, for as long as creep usually takes.

    The pace is the fastest that readings allow, of loads from zero on sites that `fit` has; NaN where there are none.
    """
    sites = fit.site.tolist()
    growth = [
        _pace(load, procedure, fit.sensitivity[sites.index(load.site)]) for load in loadings if load.site in sites
    ]
    pace, weight = np.array(growth).reshape(-1, 2).T
    if not weight.sum() > 0:
        return math.nan
    return (abs(float(weight @ pace / weight.sum())) + PACE_SIGMAS / math.sqrt(weight.sum())) * CARRIED_ON_S


def _pace(loading: Loading, procedure: LoadProcedure, sensitivity: Floats) -> tuple[float, float]:
    """Return how fast the reading grows, 1/s of the force, and the inverse of its variance."""
    lever = loading.times_s - loading.times_s.mean()
    by_channel = sensitivity / (sensitivity @ sensitivity)
    newton = loading.without_common_mode(procedure.untouched) @ by_channel
    common_newton = loading.oscillator_std * by_channel.sum()
    variance = common_newton**2 + (loading.std.mean(axis=0) * by_channel) @ (loading.std.mean(axis=0) * by_channel)
    spread = float(lever @ lever)
    force = loading.step.force_newton
    return float(lever @ newton) / spread / force, spread * force**2 / variance
