"""Model of a plate file: sites, their tones and the counter, as arrays in SI units."""

from __future__ import annotations

import math
import os.path
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ModelWrapValidatorHandler, model_validator

from firmware_protocol.layouts import BLOCK_STRUCT, CHANNEL_COUNT, SINGLE_TONE_STRUCT, TONE_STRUCT
from firmware_protocol.packets import MAX_PAYLOAD_BYTES, PACKET_OVERHEAD_BYTES
from resonator_daemon.base.arrays import Floats, Integers
from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate_checks import findings
from resonator_daemon.base.plate_tables import (
    FORCE_SIGNALS,
    SKIN_SIGNALS,
    Calibration,
    Corners,
    Counter,
    Grid,
    Outline,
    Point,
    Response,
    Site,
    Skin,
    Thermal,
    at_least,
)
from resonator_daemon.base.toml.reading import Number, Table, check_with, load_model, nearest, read_toml

Item = TypeVar("Item", bound=np.generic)

_SHIPPED = Path(__file__).with_name("plates")


@dataclass(frozen=True, eq=False)
class ToneTable:
    """All tones of a plate in the order in which the board numbers them."""

    site_index: Integers  # (t,) into site_ids
    signal_index: Integers  # (t,) into signals
    f0_hz: Floats  # (t, 4)
    sensitivity: Floats  # (t, 4), 1/N, 1/K, 1/Pa or 1/strain
    temperature_coefficients: Floats  # (t, 3), NaN where the file does not give them


class Plate(Table):
    """A plate file, checked as a whole; its arrays are in SI units and read-only."""

    format: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    outline_mm: Outline
    transducers_mm: Annotated[tuple[Point, ...], Corners]
    force_max_newton: Annotated[Number, Field(gt=0, le=10_000)]
    # A touch between sites is shared as distance^-exponent; None where sites can only be touched one by one.
    load_sharing_exponent: Annotated[Number, Field(gt=0, le=100)] | None = None
    # Under a cover of this width w a touch at distance r loads a site with (1 + r^2/w^2)^(-3/2) of its force.
    spread_width_mm: Annotated[Number, Field(ge=0.01, le=1000)] | None = None
    counter: Counter
    thermal: Thermal = Thermal()
    response: Response | None = None
    skin: Skin | None = None
    grid: Grid | None = None
    sites: Annotated[tuple[Site, ...], at_least(1, "[[sites]]")] = ()
    calibration: Calibration = Calibration()

    @model_validator(mode="wrap")
    @classmethod
    def _every_finding_at_once(cls, raw: Any, handler: ModelWrapValidatorHandler[Plate]) -> Plate:
        return check_with(list(findings(raw)) if isinstance(raw, dict) else [], handler, raw)

    @cached_property
    def outline_m(self) -> Floats:
        """(k, 2) corners of the outline."""
        return _fixed(np.array(self.outline_mm) * 1e-3)

    @cached_property
    def transducers_m(self) -> Floats:
        """(4, 2), by channel."""
        return _fixed(np.array(self.transducers_mm) * 1e-3)

    @cached_property
    def site_ids(self) -> Integers:
        """(n,) ids; those of a grid count from 1."""
        if self.grid:
            return _fixed(np.arange(1, self.grid.shape[0] * self.grid.shape[1] + 1))
        return _fixed(np.array([site.id for site in self.sites]))

    @cached_property
    def site_positions_m(self) -> Floats:
        """(n, 2)."""
        positions_mm = self.grid.site_positions_mm if self.grid else np.array([s.position_mm for s in self.sites])
        return _fixed(positions_mm * 1e-3)

    @cached_property
    def signals(self) -> tuple[str, ...]:
        """What tones carry: those of FORCE_SIGNALS that the plate has, or SKIN_SIGNALS, each in its order."""
        if self.grid or self.sites[0].tones[0].signal in SKIN_SIGNALS:
            return SKIN_SIGNALS
        present = {tone.signal for site in self.sites for tone in site.tones}
        return tuple(signal for signal in FORCE_SIGNALS if signal in present)

    @property
    def sensor_kind(self) -> Literal["single-tone", "multitone", "skin"]:
        """Kind of sensor that the plate with its counter amounts to."""
        if self.skin is not None:
            return "skin"
        return "single-tone" if self.counter.kind == "single-tone" else "multitone"

    @property
    def decodable(self) -> bool:
        """Whether its signals are decoded to the traction on a surface, which may be touched anywhere."""
        return self.skin is not None

    @property
    def oscillators(self) -> int:
        """Number of oscillators that a board must describe for it; 0 for a counter that captures a tone."""
        return len(self.tones.f0_hz) if self.counter.frames_in_parts else 0

    @property
    def frame_bytes(self) -> int:
        """Size of one frame on the wire, packets' overhead included (PROTOCOL.md, sections 6 and 7)."""
        if not self.counter.frames_in_parts:
            return PACKET_OVERHEAD_BYTES + CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
        tones = len(self.tones.f0_hz)
        parts = math.ceil(tones / ((MAX_PAYLOAD_BYTES - BLOCK_STRUCT.size) // TONE_STRUCT.size))
        return CHANNEL_COUNT * (parts * (PACKET_OVERHEAD_BYTES + BLOCK_STRUCT.size) + tones * TONE_STRUCT.size)

    @property
    def windowed(self) -> bool:
        """Whether readings are of windows of several frames."""
        return self.skin is None

    @property
    def required_skin(self) -> Skin:
        """The skin; ConfigurationError if there is none."""
        if self.skin is None:
            raise ConfigurationError(f"plate {self.name!r} has no [skin]")
        return self.skin

    @property
    def spread_width_m(self) -> float | None:
        return None if self.spread_width_mm is None else self.spread_width_mm * 1e-3

    @cached_property
    def pilot_hz(self) -> float:
        """Tone that a single-tone counter captures while nothing is touched; by default 0.1 % above all others."""
        return self.counter.pilot_hz or 1.001 * float(self.tones.f0_hz.max())

    @cached_property
    def tones(self) -> ToneTable:
        """Sites' tones in the order of the file; those of a grid by their number k."""
        if self.grid:
            return _grid_tones(self.grid)
        tones = [(index, tone) for index, site in enumerate(self.sites) for tone in site.tones]
        return ToneTable(
            _fixed(np.array([index for index, _ in tones])),
            _fixed(np.array([self.signals.index(tone.signal) for _, tone in tones])),
            _fixed(np.array([tone.f0_hz for _, tone in tones])),
            _fixed(np.array([tone.sensitivity for _, tone in tones])),
            _fixed(np.array([tone.temperature_coefficients or (math.nan,) * 3 for _, tone in tones])),
        )


def shipped_plates() -> tuple[str, ...]:
    """Return the names of the plates that come with the daemon."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))


def load_plate(name_or_path: str, *, relative_to: Path | None = None) -> Plate:
    """Load a shipped plate by its name, or a plate file by its path.

    Raises
    ------
    ConfigurationError
        Neither a shipped name nor a readable file, or a file with findings: all of them.
    """
    shipped = shipped_plates()
    if name_or_path in shipped:
        return load_model(Plate, read_toml(_SHIPPED / f"{name_or_path}.toml"))
    path = (relative_to or Path()) / name_or_path
    if not os.path.exists(path):  # Path.exists raises on names that are too long
        raise ConfigurationError(
            f"no shipped plate and no file is named {name_or_path!r}; {nearest(name_or_path, shipped)}"
        )
    return load_model(Plate, read_toml(path))


def _fixed(array: NDArray[Item]) -> NDArray[Item]:
    array.setflags(write=False)
    return array


def _grid_tones(grid: Grid) -> ToneTable:
    by_number = np.argsort(grid.tone_numbers, axis=None)
    site_index, component = np.divmod(by_number, len(grid.signals))
    f0_hz = grid.f0_hz + np.arange(grid.tone_count) * grid.spacing_hz
    signal_index = np.array([SKIN_SIGNALS.index(signal) for signal in grid.signals])
    return ToneTable(
        _fixed(site_index),
        _fixed(signal_index[component]),
        _fixed(np.repeat(f0_hz[:, None], CHANNEL_COUNT, axis=1)),
        _fixed(np.repeat(np.array(grid.sensitivity)[component, None], CHANNEL_COUNT, axis=1)),
        _fixed(np.full((grid.tone_count, 3), math.nan)),
    )
