"""What a skin with a set of sensors resolves and what not: as tables, or as one object."""

import math
from typing import Any, Final

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

from resonator_daemon.extensions.planning.sensor_array import LOADS, Load, Loss, SensorArray, SensorSet
from resonator_daemon.tools.view.words import UNKNOWN, number_table, quantity

_LOAD_NAMES: Final[dict[Load, str]] = {
    "normal": "normal, whatever the shear",
    "shear": "shear, whatever the pressure",
    "normal_alone": "normal, no shear present",
}
_LOSSES: Final[dict[Loss, str]] = {
    "none": "all three components of a load are distinguished",
    "too_few": "fewer signals than the three components of a load",
    "incompressible": "strains of an incompressible skin do not contain the mean stress; add p_n",
    "dependent": "the signals follow from each other",
}


class SensorPlan:
    """Figures of merit of one array; renders itself for a terminal."""

    def __init__(self, array: SensorArray) -> None:
        self._array = array
        self._sensors = array.sensors
        self._features = {load: array.features(load) for load in LOADS}

    def as_json(self) -> dict[str, Any]:
        """Everything that is shown, in SI units; null is what there is not."""
        array, sensors = self._array, self._sensors
        return {
            "components": list(sensors.components),
            "youngs_modulus_pascal": sensors.half_space.youngs_modulus_pascal,
            "poisson_ratio": sensors.half_space.poisson_ratio,
            "depth_m": sensors.depth_m,
            "pitch_m": array.pitch_m,
            "snr_db": array.snr_db,
            "rank": sensors.best_rank,
            "loss": sensors.loss,
            "signals": [
                {
                    "components": list(row.components),
                    "bandwidth_rad_per_m": row.bandwidth_rad_per_m,
                    "asymmetry": row.asymmetry,
                    "strongest_per_pascal": _strongest_per_pascal(row),
                    "blind_directions_rad": list(row.blind_directions_rad),
                }
                for row in self._rows()
            ],
            "resolved": {
                load: {name: value if math.isfinite(value) else None for name, value in found._asdict().items()}
                | {"even_loads": found.coarsest_m == math.inf}
                for load, found in self._features.items()
            },
        }

    def _rows(self) -> list[SensorSet]:
        """Return each signal alone, then the set."""
        sensors = self._sensors
        alone = [SensorSet(sensors.half_space, (name,), sensors.depth_m) for name in sensors.components]
        return [*alone, sensors]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = number_table("signal", "bandwidth rad/mm", "asymmetry", "strongest 1e-6/kPa", "blind at")
        for row in self._rows():
            table.add_row(
                "set" if row is self._sensors else row.components[0],
                f"{1e-3 * row.bandwidth_rad_per_m:.3f}",
                f"{row.asymmetry:.3f}",
                f"{1e9 * _strongest_per_pascal(row):.0f}",
                ", ".join(f"{math.degrees(angle):.4g}°" for angle in row.blind_directions_rad) or UNKNOWN,
            )
        yield table
        yield f"Rank {self._sensors.best_rank} of 3: {_LOSSES[self._sensors.loss]}."
        yield ""
        yield self._resolution_table()

    def _resolution_table(self) -> Table:
        table = number_table("resolved load", "finest mm", "best direction mm", "coarsest mm")
        for load, found in self._features.items():
            widest = "even" if found.coarsest_m == math.inf else _mm(found.coarsest_m)
            table.add_row(_LOAD_NAMES[load], _mm(found.finest_m), _mm(found.finest_in_best_direction_m), widest)
        return table


def _strongest_per_pascal(sensors: SensorSet) -> float:
    return math.sqrt(sensors.highest_power) / (2.0 * sensors.half_space.shear_modulus_pascal)


def _mm(value_m: float) -> str:
    return quantity(1e3 * value_m, ".3g" if value_m < 1.0 else ".4g", "")
