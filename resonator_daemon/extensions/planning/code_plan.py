"""A plan of codes: its ladder, what it bears and what it costs, as tables, a picture, or one object."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import Counter
from resonator_daemon.estimate.forces.codes import CodeOverlap
from resonator_daemon.extensions.planning.code_ladder import ForceNoise, GuardBand
from resonator_daemon.extensions.planning.code_trials import Outcomes
from resonator_daemon.extensions.planning.figures import write_code_figure
from resonator_daemon.tools.view.words import number_table, quantity

BITS_A_BYTE: Final = 10  # on a serial line: start bit, 8 data bits, stop bit

_CAUSES: Final = {
    "force": "largest force, all sensitivities",
    "temperature": "temperature coefficients of two sites",
    "ageing": "ageing of two sites",
    "noise": "noise and error of K, odds of 1000 : 1",
    "pulling": "pulling by the corners",
    "placement": "placement of two tones",
    "common": "common shift, unnoticed without a pilot",
}


@dataclass(frozen=True)
class Trials:
    """What a simulation counted; `nearest_wrong` is the share that the nearest band misses, by common shift."""

    plates: int
    plates_overlapping: int
    one_touch: Outcomes
    two_touches: Outcomes
    nearest_wrong: Mapping[float, float]


@dataclass(frozen=True, eq=False)
class CodePlan:
    """Codes of a plate, by site, and all that was found of them; `codes` count from the highest tone, 1."""

    plate: Plate
    codes: NDArray[np.int64]
    step: float  # least between two tones on one channel, relative
    guard: GuardBand
    too_near: tuple[tuple[int, int], ...]  # sites, by id, whose codes couple too much
    overlaps: tuple[CodeOverlap, ...]
    refused: tuple[str, ...]
    trapped_band: float
    baud: float
    window_s: float
    has_pilot: bool
    noise: Mapping[str, ForceNoise]
    trials: Trials

    @property
    def _band_hz(self) -> float:
        """From the pilot, where there is one, down to the lowest tone under the largest force."""
        low, high = self.bands_hz()
        pilot_hz = self.plate.pilot_hz if self.has_pilot else 0.0
        return max(pilot_hz, float(high.max())) - float(low.min())

    def bands_hz(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest frequency of each site (m,), over forces and channels."""
        tones = self.plate.tones
        loaded = tones.f0_hz / (1.0 - tones.sensitivity * self.plate.force_max_newton)
        return np.minimum(loaded, tones.f0_hz).min(axis=1), np.maximum(loaded, tones.f0_hz).max(axis=1)

    def _loads(self) -> dict[str, int]:
        """Bytes of a frame by kind of counter."""
        counters = {kind: Counter.model_validate({"kind": kind}) for kind in ("single-tone", "channelised")}
        return {kind: self.plate.model_copy(update={"counter": c}).frame_bytes for kind, c in counters.items()}

    def as_json(self) -> dict[str, Any]:
        """Everything that is shown but the picture."""
        plate, trials = self.plate, self.trials
        ids = plate.site_ids.tolist()
        rate_hz = plate.counter.frame_rate_hz
        ladder_hz = float(np.ptp(plate.tones.f0_hz))
        return {
            "ok": not self.refused,
            "refused": list(self.refused),
            "plate": plate.name,
            "sites": [
                {
                    "site": site,
                    "position_m": plate.site_positions_m[row].tolist(),
                    "code": int(self.codes[row]),
                    "f0_hz": plate.tones.f0_hz[row].tolist(),
                    "sensitivity": plate.tones.sensitivity[row].tolist(),
                }
                for row, site in enumerate(ids)
            ],
            "step_ppm": None if math.isnan(self.step) else 1e6 * self.step,
            "guard_band_ppm": {cause: 1e6 * share for cause, share in self.guard._asdict().items()}
            | {"step": 1e6 * self.guard.step},
            "neighbours_too_near": [list(pair) for pair in self.too_near],
            "codes_may_overlap": plate.counter.codes_may_overlap,
            "overlaps": [
                {
                    "sites": [ids[found.site], ids[found.other]],
                    "channel": found.channel,
                    "spacing_ppm": found.spacing_ppm,
                    "needed_ppm": found.needed_ppm,
                }
                for found in self.overlaps
            ],
            "band": {
                "codes_hz": ladder_hz,
                "codes_ppm": 1e6 * ladder_hz / plate.pilot_hz,
                "pilot_hz": plate.pilot_hz if self.has_pilot else None,
                "used_hz": self._band_hz,
                "used_ppm": 1e6 * self._band_hz / plate.pilot_hz,
                "trapped_ppm": 1e6 * self.trapped_band,
                "share": self._band_hz / plate.pilot_hz / self.trapped_band,
            },
            "link": {
                kind: {
                    "frame_bytes": size,
                    "frame_rate_hz": rate_hz,
                    "bytes_per_s": size * rate_hz,
                    "share_of_baud": size * rate_hz * BITS_A_BYTE / self.baud,
                }
                for kind, size in self._loads().items()
            },
            "force_noise": {"window_s": self.window_s} | {name: noise._asdict() for name, noise in self.noise.items()},
            "trials": {
                "plates": trials.plates,
                "plates_overlapping": trials.plates_overlapping,
                "one_touch": trials.one_touch._asdict(),
                "two_touches": trials.two_touches._asdict(),
                "nearest_wrong": [{"common_ppm": 1e6 * c, "share": w} for c, w in trials.nearest_wrong.items()],
            },
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for part in (self._site_table, self._guard_table, self._cost_table, self._noise_table, self._trial_table):
            yield part()
            yield ""
        yield from self._sentences()

    def _site_table(self) -> Table:
        table = number_table("code", "site", "x mm", "y mm", "f0 Hz", "K ppm/N", "at the largest force Hz")
        tones = self.plate.tones
        for index in np.argsort(self.codes).tolist():
            x_m, y_m = self.plate.site_positions_m[index]
            f0_hz, sensitivity = float(tones.f0_hz[index].mean()), float(tones.sensitivity[index].mean())
            table.add_row(
                str(self.codes[index]),
                str(self.plate.site_ids[index]),
                f"{1e3 * x_m:.2f}",
                f"{1e3 * y_m:.2f}",
                f"{f0_hz:.1f}",
                f"{1e6 * sensitivity:.3g}",
                f"{f0_hz / (1.0 - sensitivity * self.plate.force_max_newton):.1f}",
            )
        if self.has_pilot:
            table.add_row("pilot", "", "", "", f"{self.plate.pilot_hz:.1f}", "", "")
        return table

    def _guard_table(self) -> Table:
        table = number_table("a step must hold", "ppm")
        for cause, share in self.guard._asdict().items():
            if share:
                table.add_row(_CAUSES[cause], f"{1e6 * share:.1f}")
        table.add_row("together", f"{1e6 * self.guard.step:.1f}")
        table.add_row("least between two tones", quantity(1e6 * self.step, ".1f", ""))
        return table

    def _cost_table(self) -> Table:
        band = self.as_json()["band"]
        table = number_table("uses", "", "", "share")
        table.add_row(
            "band, down to full load",
            f"{band['used_ppm']:.0f} ppm",
            f"{1e-3 * band['used_hz']:.2f} kHz",
            f"{band['share']:.0%} of {band['trapped_ppm']:.0f} ppm",
        )
        rate_hz = self.plate.counter.frame_rate_hz
        for kind, size in self._loads().items():
            table.add_row(
                f"link, {kind}",
                f"{size} bytes x {rate_hz:g}/s",
                f"{1e-3 * size * rate_hz:.0f} kB/s",
                f"{size * rate_hz * BITS_A_BYTE / self.baud:.0%} of {self.baud:.0f} baud",
            )
        return table

    def _noise_table(self) -> Table:
        table = number_table(
            f"noise of a force over {1e3 * self.window_s:g} ms", "counter mN", "oscillator mN", "both mN"
        )
        for name, noise in self.noise.items():
            table.add_row(name.replace("_", " "), *(f"{1e3 * value:.2g}" for value in noise))
        return table

    def _trial_table(self) -> Table:
        table = number_table("touches, simulated", "number", "right", "one of two", "wrong", "undecided")
        for name, found in (("one site", self.trials.one_touch), ("two sites", self.trials.two_touches)):
            if found.touches:
                # None of n is below 3 / n, at 95 %.
                shares = [f"{n / found.touches:.2%}" if n else f"0 (< {300 / found.touches:.2g}%)" for n in found]
                table.add_row(name, str(found.touches), *shares)
        return table

    def _sentences(self) -> list[str]:
        trials = self.trials
        nearest = ", ".join(f"{share:.2%} at {1e6 * shift:g} ppm" for shift, share in trials.nearest_wrong.items())
        overlap = f"overlap on {trials.plates_overlapping} of {trials.plates} plates drawn"
        if trials.plates == 1:
            overlap = "overlap" if trials.plates_overlapping else "do not overlap"
        sentences = [
            f"Codes {overlap}.",
            f"By the nearest band alone, with all tones off together, wrong: {nearest}.",
        ]
        if self.too_near:
            pairs = ", ".join(f"{one} and {other}" for one, other in self.too_near[:5])
            more = f" and {len(self.too_near) - 5} more pairs" if len(self.too_near) > 5 else ""
            sentences.append(
                f"Coupling: the codes of sites {pairs}{more} are too near each other on the ladder; a wider band or "
                "sites further apart would do."
            )
        return sentences

    def write_picture(self, path: Path) -> None:
        """Write plate and ladder to an SVG, PNG or PDF file; a UserError names what is missing."""
        write_code_figure(path, self.plate, self.codes, self.bands_hz(), self.guard.step, has_pilot=self.has_pilot)
