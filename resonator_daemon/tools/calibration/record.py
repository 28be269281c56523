"""Record of a calibration for the plate file, with coupling and temperature, and sentences about it."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import date, timedelta
from typing import Any, Final

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate_tables import Calibration, Coupling, Response, Validity
from resonator_daemon.estimate.forces.calibration_fit import fit_temperature
from resonator_daemon.estimate.forces.force_sites import SiteResponse
from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.tools.calibration.load_readings import site_codes
from resonator_daemon.tools.calibration.outcome import COMMON_MODE_STD, Outcome
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY

_KELVIN_MARGIN: Final = 5.0  # on either side of the temperatures of a calibration
_MODEL_ERROR_MIN: Final = 1e-3  # fewer loads than thousands cannot vouch for less
_MODEL_ERROR_KNOWN: Final = 0.3  # relative standard deviation up to which the scatter found is taken
_USUAL_CUT: Final = np.array([0.0, -0.5e-9, 1.08e-10])  # of AT quartz: a depends on the angle of cut, b and c little
_USUAL_CUT_STD: Final = np.array([1e-6, 1e-9, 1e-11])
_COUPLING_SIGMAS: Final = 3.0
_OSCILLATOR_STD: Final = 1e-9  # of the mean of a hold against the untouched plate some seconds before


@dataclass(frozen=True)
class ToneChange:
    """Values of a site's force tone, by channel (4,); None where those of the plate file stay."""

    site: int
    f0_hz: list[float]
    sensitivity: list[float] | None
    temperature_coefficients: list[float] | None = None


@dataclass(frozen=True)
class Record:
    """Everything that goes into the plate file: its tables, and the tones that change."""

    calibration: Calibration
    response: Response | None
    tones: tuple[ToneChange, ...]

    def as_json(self) -> dict[str, Any]:
        """Return [calibration] of the plate file, dates as text, with `response` and the `tones` that change."""
        return {
            **rounded(self.calibration.model_dump(mode="json")),
            "response": None if self.response is None else self.response.model_dump(),
            "tones": [asdict(tone) for tone in self.tones],
        }


def rounded(value: Any) -> Any:
    """Return a value with all its numbers to seven digits, and lists for tuples."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value


def make_record(outcome: Outcome, *, calibration_id: str, unit: str, today: date, valid_days: int) -> Record:
    """Return what goes into the plate file."""
    fit, plate, request, untouched_hz = outcome.fit, outcome.plate, outcome.request, outcome.untouched_hz
    codes = site_codes(plate)
    kelvin = plate.thermal.reference_kelvin if request.kelvin is None else request.kelvin
    found = _fit_temperature(outcome, kelvin) if request.temperatures_kelvin else None
    coefficients = codes.temperature_coefficients.copy()
    if found is not None:
        coefficients[fit.site] = found
    away_kelvin = kelvin - plate.thermal.reference_kelvin
    held_at = 1 + (np.nan_to_num(coefficients) @ away_kelvin ** np.arange(1, 4))[:, None]  # 0 where none are given
    f0_hz = (codes.f0_hz if untouched_hz is None else untouched_hz) / held_at
    if untouched_hz is None:
        f0_hz[fit.site] = fit.f0_hz / held_at[fit.site]
    rows = {site: row for row, site in enumerate(fit.site.tolist())}
    kelvins = [kelvin, *request.temperatures_kelvin]
    heaviest_newton = fit.force_range_newton[1]
    return Record(
        Calibration.model_construct(
            id=calibration_id,
            date=today,
            unit=unit,
            temperature_kelvin=kelvin,
            model_error=_model_error(outcome),
            sensitivity_std=min(0.5, math.sqrt(np.mean(outcome.sensitivity_std**2))),
            sites=tuple(int(plate.site_ids[site]) for site in rows),
            residuals=tuple(np.hypot(fit.site_residual_newton, outcome.creep_std * heaviest_newton).tolist()),
            coupling=() if untouched_hz is None else _find_coupling(outcome),
            validity=Validity.model_construct(
                force_newton=(0.0, heaviest_newton),
                kelvin=(min(kelvins) - _KELVIN_MARGIN, max(kelvins) + _KELVIN_MARGIN),
            ),
            expiry=today + timedelta(days=valid_days),
        ),
        None if fit.response is None else _response(fit.response),
        tuple(
            ToneChange(
                int(plate.site_ids[site]),
                f0_hz[site].tolist(),
                fit.sensitivity[rows[site]].tolist() if site in rows else None,
                found[rows[site]].tolist() if found is not None and site in rows else None,
            )
            for site in (rows if untouched_hz is None else range(len(plate.site_ids)))
        ),
    )


def _fit_temperature(outcome: Outcome, kelvin: float) -> Floats:
    """Return coefficients (s, 3) from the heaviest mass at each temperature."""
    fit, plate, procedure = outcome.fit, outcome.plate, outcome.procedure
    heaviest_kg = outcome.request.masses_kg[-1]
    kelvins = np.array([kelvin, *outcome.request.temperatures_kelvin])
    shift = np.empty((len(kelvins), len(fit.site)))
    for column, site in enumerate(fit.site.tolist()):
        for row, warmth in enumerate(kelvins):
            loads = [
                load.without_common_mode(procedure.untouched).mean()
                for load in procedure.loadings.values()
                if (load.site, load.step.kelvin, load.step.mass_kg) == (site, warmth, heaviest_kg)
            ]
            shift[row, column] = np.mean(loads)
    touch = _model_error(outcome) * np.abs(fit.sensitivity).mean(axis=1) * heaviest_kg * STANDARD_GRAVITY
    # A load's scatter is independent from channel to channel.
    std = np.hypot(COMMON_MODE_STD, touch / math.sqrt(fit.sensitivity.shape[1]))
    found = fit_temperature(kelvins, shift, std, _USUAL_CUT, _USUAL_CUT_STD, plate.thermal.reference_kelvin)
    return found.coefficient


def _model_error(outcome: Outcome) -> float:
    fit = outcome.fit
    if not fit.model_error_std < _MODEL_ERROR_KNOWN * fit.model_error:
        return outcome.plate.calibration.model_error
    return min(max(fit.model_error, _MODEL_ERROR_MIN), 0.5)


def _response(response: SiteResponse) -> Response:
    spread = max(
        response.hysteresis_std_newton / max(response.hysteresis_newton, 1e-9),
        response.creep_fraction_std / max(response.creep_fraction, 1e-9),
        response.creep_time_std_s / response.creep_time_s,
    )
    return Response.model_construct(
        hysteresis_newton=response.hysteresis_newton,
        creep_fraction=response.creep_fraction,
        creep_time_s=response.creep_time_s,
        relative_std=min(max(spread, 0.01), 1.0),
    )


def _find_coupling(outcome: Outcome) -> tuple[Coupling, ...]:
    """Return shares of a load that other sites feel, where they lie above 3 standard deviations."""
    plate, procedure, doubtful = outcome.plate, outcome.procedure, {step.number for step in outcome.doubtful}
    sensitivity = site_codes(plate).sensitivity.copy()
    sensitivity[outcome.fit.site] = outcome.fit.sensitivity
    square = (sensitivity**2).sum(axis=1)
    used = [
        load
        for load in procedure.loadings.values()
        if not load.step.at_temperature and load.step.number not in doubtful
    ]
    found = []
    for pressed in sorted({load.site for load in used}):
        loads = [load for load in used if load.site == pressed]
        force = np.array([load.step.force_newton for load in loads])
        newton = np.array(
            [(_moved(procedure, load) * sensitivity).sum(axis=1) / square for load in loads]
        )  # (k, sites)
        ratio = force @ newton / (force @ force)
        std = _OSCILLATOR_STD / np.sqrt(square / sensitivity.shape[1]) / np.sqrt(force @ force)
        found += [
            Coupling.model_construct(
                pressed=int(plate.site_ids[pressed]),
                measured=int(plate.site_ids[measured]),
                ratio=float(ratio[measured]),
            )
            for measured in np.flatnonzero(np.abs(ratio) > _COUPLING_SIGMAS * std)
            if measured != pressed
        ]
    return tuple(found)


def _moved(procedure: LoadProcedure, loading: Loading) -> Floats:
    """Shift (sites, 4) since the untouched reading before the load, the common mode taken out of both."""
    if loading.site_shift is None:
        raise ValueError("a loading of a plate that counts one site at a time")
    before = procedure.untouched.before(loading.since_s)
    rest = 1 - (1 - procedure.untouched.site_shift[before]) * (1 + procedure.untouched.common_mode[before])
    common = procedure.untouched.at(float(loading.times_s.mean()))
    moved: Floats = 1 - (1 - loading.site_shift) * (1 + common) - rest
    return moved


def summary(outcome: Outcome, record: Record) -> Iterator[str]:
    """Yield lines on the sites, the whole, and the response."""
    calibration, fit = record.calibration, outcome.fit
    for row, site_id in enumerate(calibration.sites):
        sensitivity = ", ".join(f"{value:.4g}" for value in fit.sensitivity[row])
        residual = f"residual {1e3 * fit.site_residual_newton[row]:.2f} mN rms"
        if outcome.creep_std:
            with_creep = f"{1e3 * calibration.residuals[row]:.2f} mN with the creep that holds do not rule out"
            residual += f" of its loads, {with_creep}"
        yield f"site {site_id}: K = {sensitivity} 1/N; {residual}"
    if (validity := calibration.validity) is not None:
        yield (
            f"model error {100 * calibration.model_error:.2g} %, K known to {100 * calibration.sensitivity_std:.2g} %, "
            f"valid to {validity.force_newton[1]:.3g} N, {validity.kelvin[0]:g} to {validity.kelvin[1]:g} K, "
            f"until {calibration.expiry}"
        )
    if (response := record.response) is not None:
        yield (
            f"hysteresis {1e3 * response.hysteresis_newton:.1f} mN, creep {100 * response.creep_fraction:.2g} % "
            f"in {response.creep_time_s:.3g} s"
        )


def notes(outcome: Outcome, record: Record) -> list[str]:
    """Return sentences on what the record does not hold or holds with less weight."""
    plate, request, calibration = outcome.plate, outcome.request, record.calibration
    found = []
    if kept := [str(site_id) for site_id in plate.site_ids.tolist() if site_id not in calibration.sites]:
        values = "values" if outcome.untouched_hz is None else "sensitivities"
        found.append(f"not loaded, {values} kept: sites {', '.join(kept)}")
    if outcome.untouched_hz is None and np.isnan(outcome.fit.f0_std).any():
        found.append("one mass alone does not determine f0: it was kept where a site had no other")
    if len(request.masses_kg) * request.repeats < 3:
        found.append("two loads or fewer of a site always fit: their residuals mean nothing")
    if calibration.model_error != outcome.fit.model_error:
        found.append(
            f"model_error {calibration.model_error:.3g} stays: the loads are too few, or too good, to determine another"
        )
    if record.response is None:
        found.append(
            f"hysteresis and creep were not fitted (--response): at the pace of the holds sites may creep by "
            f"{100 * outcome.creep_share:.2g} % more, which is in sensitivity_std and residuals; loads from zero do "
            "not show hysteresis, and no error of this result includes it"
        )
    if request.kelvin is None:
        found.append(f"temperature not given (--kelvin): taken as {calibration.temperature_kelvin:g} K")
    return found
