"""What a skin with a set of sensors can and cannot feel: as one sentence, tables, pictures, or one object."""

import math
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, ConsoleOptions, RenderResult
from rich.segment import Segment
from rich.table import Table

from resonator_daemon.estimate.elastic.sensor_resolution import LOADS, Load, SensorArray
from resonator_daemon.estimate.elastic.sensor_sets import SensorSet
from resonator_daemon.extensions.planning.figures import write_density_figure
from resonator_daemon.tools.view.maps import side_by_side, traction_map
from resonator_daemon.tools.view.words import UNKNOWN, number_table, quantity

FEATURES_M: Final = (0.5e-3, 1e-3, 2e-3, 4e-3)

_EDGE_IN_DEPTHS: Final = 3.0  # of omega times depth, at the border of the pictures
_PIXELS: Final = 22
_GAP: Final = 2
_FIGURE_PIXELS: Final = 241
_DIRECTIONS_RAD: Final = np.radians(np.linspace(0.0, 90.0, 13))
_BOTH: Final[tuple[Load, Load]] = ("normal", "shear")
_LOAD_NAMES: Final[dict[Load, str]] = {
    "normal": "normal, whatever the shear",
    "shear": "shear, whatever the pressure",
    "normal_alone": "normal, no shear present",
}


class SensorPlan:
    """Figures of merit of one array; renders itself for a terminal."""

    def __init__(self, array: SensorArray) -> None:
        self._array = array
        self._sensors = array.sensors
        self._names = array.sensors.components
        self._rows = [SensorSet(self._sensors.half_space, (name,), self._sensors.depth_m) for name in self._names]
        self._features = {load: array.features_m(load) for load in LOADS}

    @cached_property
    def _best(self) -> dict[Load, float]:
        return {
            load: min(
                (self._array.features_m(load, angle)[0] for angle in _DIRECTIONS_RAD),
                key=lambda finest_m: (math.isnan(finest_m), finest_m),
            )
            for load in LOADS
        }

    @cached_property
    def _deepest(self) -> dict[Load, list[float]]:
        return _for_features(self._array.deepest_m)

    @cached_property
    def _widest(self) -> dict[Load, list[float]]:
        return _for_features(self._array.widest_pitch_m)

    @cached_property
    def _condition(self) -> tuple[float, float]:
        """Least and largest, by direction, where omega = 1 / depth."""
        omega = 1.0 / self._sensors.depth_m
        condition = self._sensors.condition(omega * np.cos(_DIRECTIONS_RAD), omega * np.sin(_DIRECTIONS_RAD))
        return float(condition.min()), float(condition.max())

    def as_json(self) -> dict[str, Any]:
        """Everything that is shown but the pictures, in SI units; null is what there is not."""
        array, sensors = self._array, self._sensors
        return {
            "components": list(self._names),
            "youngs_modulus_pascal": sensors.half_space.youngs_modulus_pascal,
            "poisson_ratio": sensors.half_space.poisson_ratio,
            "depth_m": sensors.depth_m,
            "pitch_m": array.pitch_m,
            "snr_db": array.snr_db,
            "rank": sensors.best_rank,
            "loss": sensors.loss,
            "condition_at_inverse_depth": [_or_none(value) for value in self._condition],
            "signals": [self._signal_json(row) for row in self._rows],
            "set": self._signal_json(sensors),
            "resolved": {
                load: {
                    "finest_m": _or_none(finest),
                    "coarsest_m": _or_none(coarsest),
                    "even_loads": coarsest == math.inf,
                    "finest_in_best_direction_m": _or_none(self._best[load]),
                }
                for load, (finest, coarsest) in self._features.items()
            },
            "features": [
                {
                    "feature_m": feature_m,
                    "deepest_m": {load: _or_none(self._deepest[load][n]) for load in LOADS},
                    "widest_pitch_m": {load: _or_none(self._widest[load][n]) for load in LOADS},
                }
                for n, feature_m in enumerate(FEATURES_M)
            ],
            "sentence": self.sentence(),
        }

    def _signal_json(self, sensors: SensorSet) -> dict[str, Any]:
        return {
            "components": list(sensors.components),
            "bandwidth_rad_per_m": sensors.bandwidth_rad_per_m,
            "asymmetry": sensors.asymmetry,
            "strongest_per_pascal": _strongest_per_pascal(sensors),
            "blind_directions_rad": list(sensors.blind_directions_rad),
        }

    def sentence(self) -> str:
        """Return sentences on what is resolved, and what is not and why."""
        words: dict[Load, str] = {
            "normal": "normal load {}, whatever the shear",
            "shear": "shear {}, whatever the normal load",
            "normal_alone": "the normal load of a touch without friction {}",
        }
        felt = [words[load].format(self._range(load)) for load in LOADS if self._resolves(load)]
        place = (
            f"{_mm(self._sensors.depth_m)} mm deep and {_mm(self._array.pitch_m)} mm apart at {self._array.snr_db:g} dB"
        )
        start = f"{', '.join(self._names)}, {place}: resolves {'; '.join(felt) or 'no load in all directions'}."
        return " ".join([start, *self._limits()])

    def _resolves(self, load: Load) -> bool:
        return not math.isnan(self._features[load][0])

    def _range(self, load: Load) -> str:
        finest, coarsest = self._features[load]
        return f"{'' if coarsest == math.inf else f'from {_mm(coarsest)} mm '}down to {_mm(finest)} mm"

    def _limits(self) -> list[str]:
        sensors, sentences = self._sensors, []
        if sensors.loss != "none":
            sentences.append(f"It cannot separate all three components of a load: {self._why()}.")
        if sensors.blind_directions_rad:
            directions = " and ".join(map(_degrees, sensors.blind_directions_rad))
            sentences.append(f"It misses a part of loads that vary only along {directions}, where the rank drops.")
        hidden = [load for load in _BOTH if not self._resolves(load)]
        if hidden and not sentences:
            sentences.append(
                f"Noise and pitch hide {' and '.join(hidden)} of every width: go shallower, closer or quieter."
            )
        return sentences

    def _why(self) -> str:
        if self._sensors.loss == "too_few":
            few = "one signal gives" if len(self._names) == 1 else f"{len(self._names)} signals give"
            return f"{few} rank {self._sensors.best_rank}"
        if self._sensors.loss == "incompressible":
            return (
                "the skin is incompressible (Poisson's ratio 1/2), so that strains do not depend on the mean stress at "
                f"any frequency and give rank {self._sensors.best_rank}; add p_n"
            )
        if set(self._names) <= {"xx", "yy", "xy"}:
            return "strains in the plane follow from two displacements (compatibility)"
        return f"its components follow from each other and give rank {self._sensors.best_rank}"

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        colours = console.color_system in ("256", "truecolor") and not console.no_color
        yield self.sentence()
        yield ""
        yield self._signal_table()
        low, high = (quantity(value, ".1f", "") if value < math.inf else "infinite" for value in self._condition)
        condition = low if low == high else f"{low} to {high}, by direction"
        yield f"Rank {self._sensors.best_rank} of 3. Condition where omega = 1 / depth: {condition}."
        yield ""
        yield self._resolution_table()
        yield ""
        yield "Deepest skin and widest pitch that resolve a feature, all else as given (no shear: normal load alone):"
        yield self._feature_table()
        yield ""
        edge = _EDGE_IN_DEPTHS / self._sensors.depth_m
        yield (
            f"Power density of each signal, then of the set: omega_x to the right and omega_y downwards, to "
            f"{1e-3 * edge:.3g} rad/mm; {'bright' if colours else 'dense'} is strong, each scaled to its own maximum."
        )
        yield from self._pictures(options.max_width, colours=colours)

    def _signal_table(self) -> Table:
        table = number_table("signal", "bandwidth rad/mm", "asymmetry", "strongest 1e-6/kPa", "blind at")
        for name, sensors in [*zip(self._names, self._rows, strict=True), ("set", self._sensors)]:
            table.add_row(
                name,
                f"{1e-3 * sensors.bandwidth_rad_per_m:.3f}",
                f"{sensors.asymmetry:.3f}",
                f"{1e9 * _strongest_per_pascal(sensors):.0f}",
                ", ".join(map(_degrees, sensors.blind_directions_rad)) or UNKNOWN,
            )
        return table

    def _resolution_table(self) -> Table:
        table = number_table("load", "finest mm", "best direction mm", "coarsest mm")
        for load, (finest, coarsest) in self._features.items():
            widest = "even" if coarsest == math.inf else _mm(coarsest)
            table.add_row(_LOAD_NAMES[load], _mm(finest), _mm(self._best[load]), widest)
        return table

    def _feature_table(self) -> Table:
        table = number_table(
            "feature mm", "deepest mm: normal", "shear", "no shear", "widest pitch mm: normal", "shear", "no shear"
        )
        for n, feature_m in enumerate(FEATURES_M):
            values = [found[load][n] for found in (self._deepest, self._widest) for load in LOADS]
            table.add_row(_mm(feature_m), *map(_mm, values))
        return table

    def _pictures(self, columns: int, *, colours: bool) -> RenderResult:
        half = _EDGE_IN_DEPTHS / self._sensors.depth_m
        omega = half * (2.0 * (np.arange(_PIXELS) + 0.5) / _PIXELS - 1.0)
        blocks = [
            (_PIXELS + _GAP, [[Segment(name)], *traction_map(power / power.max(), 1.0, 1, colours=colours)])
            for name, power in zip([*self._names, "set"], self._power(omega), strict=True)
        ]
        across = max(columns // (_PIXELS + _GAP), 1)
        for first in range(0, len(blocks), across):
            yield from side_by_side(blocks[first : first + across])

    def _power(self, omega_rad_per_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the spectra (n + 1, m, m) of the signals and of the set."""
        rows = np.moveaxis(self._sensors.power(omega_rad_per_m, omega_rad_per_m[:, None]), -1, 0)
        return np.concatenate([rows, rows.sum(axis=0)[None]])

    def write_picture(self, path: Path) -> None:
        """Write the pictures to an SVG, PNG or PDF file; a UserError names what is missing."""
        omega = np.linspace(-1.0, 1.0, _FIGURE_PIXELS) * _EDGE_IN_DEPTHS / self._sensors.depth_m
        title = f"Power density {_mm(self._sensors.depth_m)} mm deep, dark is strong"
        power = self._power(omega)
        power[:, _FIGURE_PIXELS // 2, _FIGURE_PIXELS // 2] = np.nan  # no limit that all directions share
        write_density_figure(path, [*self._names, "set"], power, omega, title)


def _for_features(judge: Callable[[Load, float], float]) -> dict[Load, list[float]]:
    return {load: [judge(load, feature_m) for feature_m in FEATURES_M] for load in LOADS}


def _strongest_per_pascal(sensors: SensorSet) -> float:
    return math.sqrt(sensors.highest_power) / (2.0 * sensors.half_space.shear_modulus_pascal)


def _mm(value_m: float) -> str:
    return quantity(1e3 * value_m, ".3g" if value_m < 1.0 else ".4g", "")


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.4g}°"


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
