"""What a calibration asks for, step by step: which mass on which site, at which temperature, for how long."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

from resonator_daemon.errors import UsageError
from resonator_daemon.plate import Plate

STANDARD_GRAVITY: Final = 9.80665  # m/s^2, ISO 80000-3
SENSITIVITY_STD_MAX: Final = 0.05  # relative, of each site's K: what is known worse is no calibration
_KELVIN: Final = (100.0, 600.0)  # as in a plate file


@dataclass(frozen=True)
class Wanted:
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
    unloading: bool = False
    continues: bool = False
    at_temperature: bool = False  # of the temperature sweep

    @property
    def force_newton(self) -> float:
        return self.mass_kg * STANDARD_GRAVITY

    @property
    def load(self) -> str:
        """Mass and place, as in "200 g on site 7"."""
        return f"{self.mass_kg * 1e3:g} g on site {self.site_id}"


def plan_steps(wanted: Wanted, plate: Plate) -> tuple[Step, ...]:
    """Return the steps in their order.

    Raises
    ------
    UsageError
        One message for each finding: field, value and limit.
    """
    if findings := [*_site_findings(wanted, plate), *_mass_findings(wanted, plate), *_other_findings(wanted)]:
        raise UsageError(*findings)
    kelvin = plate.thermal.reference_kelvin if wanted.kelvin is None else wanted.kelvin
    site_ids = wanted.sites or tuple(plate.site_ids.tolist())
    loads = [
        *(load for site_id in site_ids for load in _site_loads(wanted, site_id, kelvin)),
        *(
            Step(0, site_id, wanted.masses_kg[-1], warmth, wanted.hold_s, at_temperature=True)
            for warmth in wanted.temperatures_kelvin
            for site_id in site_ids
        ),
    ]
    return tuple(replace(load, number=number) for number, load in enumerate(loads, 1))


def _site_loads(wanted: Wanted, site_id: int, kelvin: float) -> Iterator[Step]:
    """Yield the loads of one site, their numbers still open."""
    hold_s = wanted.response_hold_s if wanted.response else wanted.hold_s
    for _ in range(wanted.repeats):
        for index, mass_kg in enumerate(wanted.masses_kg):
            yield Step(0, site_id, mass_kg, kelvin, hold_s, continues=wanted.response and index > 0)
        if wanted.response:
            for mass_kg in reversed(wanted.masses_kg[:-1]):
                yield Step(0, site_id, mass_kg, kelvin, hold_s, unloading=True, continues=True)


def _site_findings(wanted: Wanted, plate: Plate) -> Iterator[str]:
    known = set(plate.site_ids.tolist())
    for site_id, times in Counter(wanted.sites).items():
        if site_id not in known:
            yield f"--sites: plate {plate.name!r} has no site {site_id}; it has {_listed(sorted(known))}"
        if times > 1:
            yield f"--sites: site {site_id} is named {times} times; name each once (--repeats loads it several times)"


def _mass_findings(wanted: Wanted, plate: Plate) -> Iterator[str]:
    grams = [mass_kg * 1e3 for mass_kg in wanted.masses_kg]
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
    if wanted.response and len(grams) == 1:
        yield "--masses-grams: 1 mass, at least 2 for --response: loading and unloading"


def _other_findings(wanted: Wanted) -> Iterator[str]:
    if not 0 <= wanted.mass_std < SENSITIVITY_STD_MAX:
        yield f"--mass-std: {wanted.mass_std:g}, must be at least 0 and below {SENSITIVITY_STD_MAX:g} (relative)"
    if not 1 <= wanted.repeats <= 1000:
        yield f"--repeats: {wanted.repeats}, must be between 1 and 1000"
    for name, seconds in (("--hold-s", wanted.hold_s), ("--response-hold-s", wanted.response_hold_s)):
        if not 0.2 <= seconds <= 3600:
            yield f"{name}: {seconds:g} s, must be between 0.2 and 3600"
    low, high = _KELVIN
    for name, values in (("--kelvin", (wanted.kelvin,)), ("--temperatures-kelvin", wanted.temperatures_kelvin)):
        for value in values:
            if value is not None and not low <= value <= high:
                yield f"{name}: {value:g} K, must be between {low:g} and {high:g}"
    if wanted.temperatures_kelvin and wanted.kelvin is None:
        yield "--kelvin: not given; a temperature sweep needs the temperature of the first loads, too"
    if len(set(wanted.temperatures_kelvin)) < len(wanted.temperatures_kelvin):
        yield "--temperatures-kelvin: a temperature is named twice; name each once"


def _listed(ids: Sequence[int]) -> str:
    """Ids with their runs shortened: 1 to 16."""
    if ids and ids[-1] - ids[0] == len(ids) - 1 and len(ids) > 2:
        return f"{ids[0]} to {ids[-1]}"
    return ", ".join(map(str, ids[:20])) + (", ..." if len(ids) > 20 else "")
