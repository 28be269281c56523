"""Frames in, readings out: the stages of measurement in their order, one chain for each kind of counter."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import SingleToneRecord
from resonator_daemon.measurement.baseline import CommonMode
from resonator_daemon.measurement.channelised import TONES_MIN, ToneArray
from resonator_daemon.measurement.contacts import Contact, ContactEvent, ContactTracker
from resonator_daemon.measurement.counting import SlidingWindow, Sums, counter_std, frequency_hz, oscillator_std
from resonator_daemon.measurement.force import FloatArray, cell_std_m, hidden_fraction
from resonator_daemon.measurement.matching import Match, Matcher, OverloadLatch, SiteForce

PILOT_TOLERANCE: Final = 100e-6  # reference error and temperature together stay below it
BAND_MARGIN: Final = 0.05  # beyond the plate's tones no press and no clock error can reach
BASELINE_READINGS: Final = 20  # untouched readings before the common mode counts as known
BASELINE_MEMORY_S: Final = 1.0
UNKNOWN_CONTACT_S: Final = 0.5
SIGMA_HZ: Final[FloatArray] = np.exp2((np.arange(256) - 128) / 8)  # by sigma_code

SensorStatus = Literal[
    "ok", "settling", "no_signal", "pilot_lost", "pressed_at_start", "ambiguous", "rejected", "overload"
]


@dataclass(frozen=True, slots=True)
class SingleToneReading:
    """Forces and contacts from one window; NaN or absent where not known, `status` and `reason` say why.

    `board_ticks` is the end of the last gate in the window. `frequency_hz` is as counted, per channel, the common mode
    still in it; `common_mode` per channel is what was taken out of it for the forces.
    """

    sequence: int
    board_ticks: int
    window_s: float
    status: SensorStatus
    reason: str
    sites: tuple[SiteForce, ...]
    contacts: tuple[Contact, ...]
    events: tuple[ContactEvent, ...]
    frequency_hz: tuple[float, ...]
    common_mode: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ChannelisedReading:
    """Signals of one frame, the dimensionless triple [3 p_n / (2 E), eps_xz, eps_yz] and its noise, both (3, sites).

    `board_ticks` is the end of the gate. NaN where not known, `status` and `reason` say why.
    """

    sequence: int
    board_ticks: int
    window_s: float
    status: SensorStatus
    reason: str
    signals: FloatArray
    noise_std: FloatArray
    common_mode: float


class SingleToneChain:
    """Counts of one captured tone per corner to forces, sites and contacts."""

    def __init__(
        self,
        f0_hz: FloatArray,
        sensitivity: FloatArray,
        site_positions_m: FloatArray,
        outline_m: FloatArray,
        *,
        force_max_newton: float,
        pilot_hz: float,
        reference_hz: float,
        gate_s: float,
        window_frames: int,
        step_frames: int,
        load_sharing_exponent: float | None = None,
    ) -> None:
        """Take a plate's codes by site.

        Parameters
        ----------
        f0_hz, sensitivity
            (m, channels); sensitivity K is signed, in 1/N.
        site_positions_m, outline_m
            (m, 2) and the polygon (p, 2).
        load_sharing_exponent
            A touch loads sites by distance^-exponent; None for a plate whose sites are touched one by one.
        """
        if step_frames < 1:
            raise ValueError(f"step of {step_frames} frames, at least 1")
        channels = f0_hz.shape[1]
        hidden = None
        if load_sharing_exponent is not None:
            hidden = hidden_fraction(site_positions_m, outline_m, load_sharing_exponent)
        band_hz = (
            (1 - BAND_MARGIN) * min(pilot_hz, float(f0_hz.min())),
            (1 + BAND_MARGIN) * max(pilot_hz, float(f0_hz.max())),
        )
        self._pilot_hz = pilot_hz
        self._reference_hz = reference_hz
        self._step_frames = step_frames
        self._window_s = window_frames * gate_s
        self._oscillator_std = oscillator_std(self._window_s)
        self._windows = [SlidingWindow(window_frames, reference_hz, band_hz) for _ in range(channels)]
        memory = round(BASELINE_MEMORY_S / (step_frames * gate_s))
        self._common_mode = CommonMode(channels, needed=BASELINE_READINGS, memory=max(memory, BASELINE_READINGS))
        self._matcher = Matcher(f0_hz, sensitivity, force_max_newton, hidden_fraction=hidden)
        self._latch = OverloadLatch()
        position_std_m = cell_std_m(site_positions_m, outline_m)
        self._tracker = ContactTracker(site_positions_m, position_std_m, round(UNKNOWN_CONTACT_S * reference_hz))
        self._last: tuple[int, int] | None = None  # sequence and ticks of the last frame
        self.unusable: Counter[str] = Counter()  # records that gave no frequency, by cause

    def restart(self) -> tuple[ContactEvent, ...]:
        """Forget the baseline and every contact: the board has booted or is configured anew."""
        events = self._tracker.close(self._last[1], "the board started anew") if self._last else ()
        for window in self._windows:
            window.restart()
        self._common_mode.reset()
        self._latch.release()
        self._last = None
        return events

    def push(self, sequence: int, board_ticks: int, records: Sequence[SingleToneRecord]) -> SingleToneReading | None:
        """Take one frame, a record per channel; gives a reading at every `step_frames`-th sequence number.

        `sequence` and `board_ticks` are unwrapped; frames that are missing between two calls restart the windows.
        """
        if len(records) != len(self._windows):
            raise ValueError(f"{len(records)} records for {len(self._windows)} channels")
        if self._last is not None and sequence != self._last[0] + 1:
            for window in self._windows:
                window.restart()
        self._last = sequence, board_ticks
        for window, record in zip(self._windows, records, strict=True):
            fault = window.push(record)
            if fault is not None:
                self.unusable[fault] += 1
        if (sequence + 1) % self._step_frames:
            return None
        return self._read(sequence, board_ticks)

    def _read(self, sequence: int, board_ticks: int) -> SingleToneReading:
        sums = [window.sums() for window in self._windows]
        heard_hz = [math.nan if s is None else frequency_hz(s, self._reference_hz) for s in sums]
        pilot = [
            f / self._pilot_hz - 1 if abs(f / self._pilot_hz - 1) < PILOT_TOLERANCE else math.nan for f in heard_hz
        ]
        pilots = sum(not math.isnan(g) for g in pilot)
        tones = sum(not math.isnan(f) for f in heard_hz) - pilots

        untouched = tones == 0 and pilots >= 2
        status: SensorStatus
        force: SiteForce | None = None
        if untouched:
            # Channels without a signal stay out of it: a touch would have taken the pilot's place on the others, too.
            self._common_mode.update(pilot)
            self._latch.release()
            status, reason = ("ok", self._missing()) if self._common_mode.known else self._learning(pilots)
        elif tones and not self._common_mode.known:
            status, reason = "pressed_at_start", "touched before the pilot was heard on all channels"
        elif tones >= 2:
            match = self._latch.apply(self._match(sums, heard_hz, pilot))
            status, reason, force = match.status, match.reason, match.force
        else:
            status, reason = self._silent(tones, pilots)

        forces = (force,) if force else ()
        unheard = ("no_signal", "another site is heard instead") if force else (status, reason)
        events = self._tracker.update(board_ticks, forces, untouched=untouched, status=unheard[0], reason=unheard[1])
        return SingleToneReading(
            sequence,
            board_ticks,
            self._window_s,
            status,
            reason,
            forces,
            self._tracker.contacts,
            events,
            tuple(heard_hz),
            self._common_mode.value,
        )

    def _match(self, sums: Sequence[Sums | None], heard_hz: Sequence[float], pilot: Sequence[float]) -> Match:
        """Match the channels that hear a tone other than the pilot."""
        counted = [
            (f / (1 + g), counter_std(s)) if s and math.isnan(p) else (math.nan, math.nan)
            for s, f, p, g in zip(sums, heard_hz, pilot, self._common_mode.value, strict=True)
        ]
        frequency, std = np.array(counted).T
        return self._matcher.match(frequency, std, self._oscillator_std)

    def _learning(self, pilots: int) -> tuple[SensorStatus, str]:
        if pilots == len(self._windows) or self._settling:
            return "settling", "the common mode is being learnt"
        return "pilot_lost", self._missing()

    def _silent(self, tones: int, pilots: int) -> tuple[SensorStatus, str]:
        """Status where too few channels are heard to tell a touch from none."""
        if self._settling:
            return "settling", self._missing()
        if tones:
            return "rejected", "heard on 1 channel, at least 2 needed"
        return ("pilot_lost" if pilots else "no_signal"), self._missing()

    @property
    def _settling(self) -> bool:
        return any(window.fault is None and not window.full for window in self._windows)

    def _missing(self) -> str:
        """Name the channels that give no frequency, each with its cause."""
        causes = [
            f"channel {channel}: {window.fault or 'window not full yet'}"
            for channel, window in enumerate(self._windows)
            if not window.full
        ]
        return ", ".join(causes)


class ChannelisedChain:
    """Offsets of many tones on four channels to the sites' signals."""

    def __init__(
        self,
        f0_hz: FloatArray,
        sensitivity: FloatArray,
        oscillator_hz: FloatArray,
        site_index: NDArray[np.integer],
        signal_index: NDArray[np.integer],
        *,
        youngs_modulus_pascal: float,
        gate_s: float,
    ) -> None:
        """Take a plate's tones as `ToneArray` does, (t, 4) and (t,), and the board's oscillators (t,)."""
        self._tones = ToneArray(f0_hz, sensitivity, oscillator_hz, site_index, signal_index, youngs_modulus_pascal)
        self._gate_s = gate_s
        memory = max(round(BASELINE_MEMORY_S / gate_s), BASELINE_READINGS)
        self._common_mode = CommonMode(1, needed=BASELINE_READINGS, memory=memory)

    def restart(self) -> None:
        """Forget the baseline: the board has booted or is configured anew."""
        self._common_mode.reset()

    def push(
        self,
        sequence: int,
        board_ticks: int,
        offset_hz16: NDArray[np.integer],
        sigma_code: NDArray[np.uint8],
        known: NDArray[np.bool_],
    ) -> ChannelisedReading:
        """Take one frame, each array (4, t): offsets in 2^-16 Hz, their noise as 2^((code - 128) / 8) Hz."""
        shape = (4, self._tones.tones)
        if offset_hz16.shape != shape or sigma_code.shape != shape or known.shape != shape:
            raise ValueError(f"shapes {offset_hz16.shape}, {sigma_code.shape} and {known.shape} must be {shape}")
        shifts = self._tones.shifts(offset_hz16.astype(np.float64) * 2.0**-16, SIGMA_HZ[sigma_code], known)
        untouched = self._tones.untouched_common_mode(shifts)
        if untouched is not None:
            self._common_mode.update([untouched])
        (common_mode,) = self._common_mode.value
        # Without a common mode every signal is NaN, like the common mode itself.
        signals, noise_std = self._tones.signals(shifts, common_mode)
        status, reason = self._status(untouched is not None, int(np.count_nonzero(shifts.weight.any(axis=0))))
        return ChannelisedReading(sequence, board_ticks, self._gate_s, status, reason, signals, noise_std, common_mode)

    def _status(self, untouched: bool, heard: int) -> tuple[SensorStatus, str]:
        if heard == 0:
            return "no_signal", "no tone is known"
        if self._common_mode.known:
            return "ok", ""
        if untouched:
            return "settling", "the common mode is being learnt"
        if heard < TONES_MIN:
            return "no_signal", f"{heard} tones known, at least {TONES_MIN} needed to learn the common mode"
        return "pressed_at_start", "touched before the common mode was learnt"
