"""Sliding windows of a single-tone counter: the last gates of each channel with continuous stamps."""

import math
from typing import Final

import numpy as np

from firmware_protocol.layouts import SINGLE_TONE_STRUCT, RecordFlag, SingleToneRecord
from resonator_daemon.estimate.tones.few_gates import Column, FewGates
from resonator_daemon.estimate.tones.frequency_estimators import FREQUENCY_JUMP, Sums, continues
from resonator_daemon.estimate.tones.gate_block import GateBlock
from resonator_daemon.estimate.tones.many_gates import ManyGates, as_arrays, begins
from resonator_daemon.estimate.tones.record_checks import RECORD, Gate, read_gate, read_gates

_STRIDE_BREAK: Final = int(RecordFlag.STRIDE_BREAK)
_FLAGS: Final = SingleToneRecord._fields.index("flags")
_NOTHING: Final[Gate] = (Sums(*[0] * 9), math.nan, math.nan)
FEW_GATES: Final = 16  # up to so many are taken one by one: arrays take longer


class ToneWindows:
    """The last `frames` gates of each channel, for as long as the same tone's stamps run on without a break.

    Gates come in blocks; how they are cut into blocks changes no result.
    """

    def __init__(self, channels: int, frames: int, reference_hz: float, band_hz: tuple[float, float]) -> None:
        """`band_hz` is the lowest and the highest frequency that the plate could ever send."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self.channels = channels
        self.frames = frames
        self._reference_hz = reference_hz
        self._band_hz = band_hz
        self._gates: list[list[Gate]] = [[] for _ in range(channels)]  # those held, the newest last

    def restart(self) -> None:
        """Discard all gates, as after a gap."""
        self._gates = [[] for _ in range(self.channels)]

    def resize(self, frames: int) -> None:
        """Set the number of gates to hold; the newest stay."""
        if frames < 1:
            raise ValueError(f"window of {frames} frames, at least 1")
        self.frames = frames
        self._gates = [gates[-frames:] for gates in self._gates]

    def push(self, payload: bytes) -> GateBlock:
        """Append the records of some gates, as on the wire: one of each channel, gate after gate.

        An unusable record empties the window of its channel; one that does not continue the last begins a new window.
        Raises ValueError where the payload is no whole number of gates, at least one.
        """
        records = len(payload) / RECORD.itemsize
        if not payload or records % self.channels:
            raise ValueError(f"{records:g} records for {self.channels} channels")
        return self._push_few(payload) if records <= FEW_GATES * self.channels else self._push_many(payload)

    def _push_few(self, payload: bytes) -> FewGates:
        records = list(SINGLE_TONE_STRUCT.iter_unpack(payload))
        channels, most, reference_hz, band_hz = self.channels, self.frames, self._reference_hz, self._band_hz
        columns: list[Column] = []
        codes = [0] * len(records)
        for channel, gates in enumerate(self._gates):
            before, first, firsts = len(gates), 0, []
            for gate, record in enumerate(records[channel::channels]):
                read = read_gate(record, reference_hz, band_hz)
                if isinstance(read, int):
                    codes[gate * channels + channel] = read
                    gates.append(_NOTHING)
                    first = len(gates)
                else:
                    if first < len(gates):
                        last_sums, last_hz, _ = gates[-1]
                        sums, hertz, _ = read
                        if (
                            record[_FLAGS] & _STRIDE_BREAK
                            or abs(hertz - last_hz) > FREQUENCY_JUMP * hertz
                            or not continues(last_sums, sums)
                        ):
                            first = len(gates)
                    gates.append(read)
                firsts.append(first)
            columns.append(Column(gates, before, firsts))
            self._gates[channel] = gates[max(first, len(gates) - most) :]
        faults = [codes[at : at + channels] for at in range(0, len(codes), channels)] if any(codes) else []
        return FewGates(columns, most, faults, records, reference_hz)

    def _push_many(self, payload: bytes) -> ManyGates:
        records = np.frombuffer(payload, RECORD).reshape(-1, self.channels)
        before, count = self.frames, len(records)
        gates = read_gates(records, self._reference_hz, self._band_hz)
        old_sums, old_lines = as_arrays(self._gates, before)
        sums = np.concatenate((old_sums, gates.sums), axis=1)
        lines = np.concatenate((old_lines, (gates.frequency_hz, gates.residual_ticks2)), axis=1)
        new = begins(sums[:, before - 1 :], lines[0, before - 1 :]) | ((records["flags"] & _STRIDE_BREAK) != 0)
        held = self._count_held(gates.fault.tolist(), new.tolist())
        block = ManyGates(before, sums, lines, gates.fault, held, records["attenuation_db256"], self._reference_hz)
        self._gates = [block.gates_held(channel, held[count - 1][channel]) for channel in range(self.channels)]
        return block

    def _count_held(self, faults: list[list[int]], begins: list[list[bool]]) -> list[list[int]]:
        rows, held, most = [], [len(gates) for gates in self._gates], self.frames
        full = [most] * self.channels
        for bad, new in zip(faults, begins, strict=True):
            if held is full and not any(bad) and not any(new):
                rows.append(full)
                continue
            held = [
                0 if unusable else 1 if begin else min(count + 1, most)
                for unusable, begin, count in zip(bad, new, held, strict=True)
            ]
            if held == full:
                held = full
            rows.append(held)
        return rows
