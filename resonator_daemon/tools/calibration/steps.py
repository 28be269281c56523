"""What a calibration asks for, step by step: mass, site, temperature, duration; and the errors that end it."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

from resonator_daemon.base.errors import ExitCode, UsageError, UserError
from resonator_daemon.base.plate import Plate

STANDARD_GRAVITY: Final = 9.80665  # m/s^2, ISO 80000-3
SENSITIVITY_STD_MAX: Final = 0.05  # relative, of each site's K: what is known worse is no calibration
_KELVIN: Final = (100.0, 600.0)  # as in a plate file


class CalibrationRefusedError(UserError):
    """The plate, its surroundings or who loads it do not allow a calibration; nothing was changed."""

    exit_code = ExitCode.FAILED
    code = "not_calibrated"


@dataclass(frozen=True)
class LoadRequest:
    """Requested loads; an empty `sites` means all of them, in the order of the plate file."""

    sites: tuple[int, ...] = ()
    masses_kg: tuple[float, ...] = (0.05, 0.2, 0.5)
    mass_std: float = 0.001  # relative
    repeats: int = 1
    hold_s: float = 3.0
    response: bool = False
    response_hold_s: float = 60.0
    kelvin: float | None = None  # of the plate; None: not measured
    temperatures_kelvin: tuple[float, ...] = ()


@dataclass(frozen=True)
class Step:
    """One mass on one site; `continues` where it follows the mass before without the site being released."""

    number: int  # from 1; the untouched baseline is step 0
    site_id: int
    mass_kg: float
    kelvin: float
    hold_s: float
    continues: bool = False
    at_temperature: bool = False  # of the temperature sweep

    @property
    def force_newton(self) -> float:
        return self.mass_kg * STANDARD_GRAVITY

    @property
    def load(self) -> str:
        """Mass and place, as in "200 g on site 7"."""
        return f"{self.mass_kg * 1e3:g} g on site {self.site_id}"


def plan_steps(request: LoadRequest, plate: Plate) -> tuple[Step, ...]:
    """Return the steps in their order.

    Raises
    ------
    UsageError
        One message for each finding: field, value and limit.
    """
    if findings := [*_site_findings(request, plate), *_mass_findings(request, plate), *_other_findings(request)]:
        raise UsageError(*findings)
    kelvin = plate.thermal.reference_kelvin if request.kelvin is None else request.kelvin
    site_ids = request.sites or tuple(plate.site_ids.tolist())
    loads = [
        *(load for site_id in site_ids for load in _site_loads(request, site_id, kelvin)),
        *(
            Step(0, site_id, request.masses_kg[-1], warmth, request.hold_s, at_temperature=True)
            for warmth in request.temperatures_kelvin
            for site_id in site_ids
        ),
    ]
    return tuple(replace(load, number=number) for number, load in enumerate(loads, 1))


def _site_loads(request: LoadRequest, site_id: int, kelvin: float) -> Iterator[Step]:
    """Yield the loads of one site, their numbers still open."""
    hold_s = request.response_hold_s if request.response else request.hold_s
    for _ in range(request.repeats):
        for index, mass_kg in enumerate(request.masses_kg):
            yield Step(0, site_id, mass_kg, kelvin, hold_s, continues=request.response and index > 0)
        if request.response:
            for mass_kg in reversed(request.masses_kg[:-1]):
                yield Step(0, site_id, mass_kg, kelvin, hold_s, continues=True)


def _site_findings(request: LoadRequest, plate: Plate) -> Iterator[str]:
    known = set(plate.site_ids.tolist())
    for site_id, times in Counter(request.sites).items():
        if site_id not in known:
            yield f"--sites: plate {plate.name!r} has no site {site_id}; it has {_listed(sorted(known))}"
        if times > 1:
            yield f"--sites: site {site_id} is named {times} times; name each once (--repeats loads it several times)"


def _mass_findings(request: LoadRequest, plate: Plate) -> Iterator[str]:
    grams = [mass_kg * 1e3 for mass_kg in request.masses_kg]
    limit_gram = plate.force_max_newton / STANDARD_GRAVITY * 1e3
    if not grams:
        yield "--masses-grams: none given; give at least one"
    for gram in grams:
        if not gram > 0:
            yield f"--masses-grams: {gram:g} g, must be above 0"
        elif gram > limit_gram:
            newton = gram * 1e-3 * STANDARD_GRAVITY
            limit = f"force_max_newton = {plate.force_max_newton:g} N, {limit_gram:.4g} g"
            yield f"--masses-grams: {gram:g} g presses with {newton:.4g} N, at most {limit}"
    for lighter, heavier in pairwise(grams):
        if not heavier > lighter:
            yield f"--masses-grams: {heavier:g} g after {lighter:g} g; masses must rise"
    if request.response and len(grams) == 1:
        yield "--masses-grams: 1 mass, at least 2 for --response: loading and unloading"


def _other_findings(request: LoadRequest) -> Iterator[str]:
    if not 0 <= request.mass_std < SENSITIVITY_STD_MAX:
        yield f"--mass-std: {request.mass_std:g}, must be at least 0 and below {SENSITIVITY_STD_MAX:g} (relative)"
    if not 1 <= request.repeats <= 1000:
        yield f"--repeats: {request.repeats}, must be between 1 and 1000"
    for name, seconds in (("--hold-s", request.hold_s), ("--response-hold-s", request.response_hold_s)):
        if not 0.2 <= seconds <= 3600:
            yield f"{name}: {seconds:g} s, must be between 0.2 and 3600"
    low, high = _KELVIN
    for name, values in (("--kelvin", (request.kelvin,)), ("--temperatures-kelvin", request.temperatures_kelvin)):
        for value in values:
            if value is not None and not low <= value <= high:
                yield f"{name}: {value:g} K, must be between {low:g} and {high:g}"
    if request.temperatures_kelvin and request.kelvin is None:
        yield "--kelvin: not given; a temperature sweep needs the temperature of the first loads, too"
    if len(set(request.temperatures_kelvin)) < len(request.temperatures_kelvin):
        yield "--temperatures-kelvin: a temperature is named twice; name each once"


def _listed(ids: Sequence[int]) -> str:
    """Ids with their runs shortened: 1 to 16."""
    if ids and ids[-1] - ids[0] == len(ids) - 1 and len(ids) > 2:
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids[:20])) + (", ..." if len(ids) > 20 else "")
