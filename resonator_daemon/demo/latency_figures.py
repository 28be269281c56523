"""From messages and the emulator's truth to latencies, and to what is missing."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final

import cbor2
import numpy as np
from numpy.typing import NDArray

from resonator_daemon.monitoring.latency import BOUNDS_MS

LATE_MS: Final = 20.0

Int64s = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message as the subscriber's callback had it."""

    t_ns: int  # UTC
    head: bytes  # of a long one the beginning, behind `board_ticks` somewhere


@dataclass(frozen=True, slots=True)
class Gates:
    """All gates that the board counted: when each ended, by its clock and by UTC; both rise."""

    board_ticks: Int64s
    end_ns: Int64s


@dataclass(frozen=True, slots=True)
class Latency:
    """What a run amounts to."""

    milliseconds: NDArray[np.float64]  # of each message, from the end of the last gate to the callback
    not_received: int  # gaps in seq: lost on the way; of a decoder process, which copies seq, also what it skipped
    not_made: int  # windows of which no message was made: frames were lost, or skipped by the daemon's own decoder

    @property
    def missing(self) -> int:
        return self.not_received + self.not_made

    @property
    def late(self) -> int:
        return int(np.count_nonzero(self.milliseconds > LATE_MS))

    def counts(self) -> tuple[int, ...]:
        """Return the messages in each bin of the daemon's own histogram."""
        bins = np.searchsorted(BOUNDS_MS, self.milliseconds)
        return tuple(np.bincount(bins, minlength=len(BOUNDS_MS) + 1).tolist())


def read_gates(truth: Iterable[str]) -> Gates:
    """Read the lines of a truth file."""
    ends = [(line["board_ticks"], int(line["t_ns"])) for line in map(json.loads, truth)]
    ticks, ends_ns = np.array(ends, np.int64).reshape(-1, 2).T
    return Gates(ticks, ends_ns)


def measure(arrivals: Sequence[Arrival], gates: Gates, gates_apart: int) -> Latency:
    """Match messages with the gates that they describe.

    Parameters
    ----------
    arrivals
        Of one topic and one run of the daemon, in the order in which they came.
    gates
        Of the board.
    gates_apart
        From one message to the next, where nothing is missing.

    Raises
    ------
    ValueError
        Nothing arrived, or a message describes a gate that the truth does not have.
    """
    if not arrivals:
        raise ValueError("no arrivals: there is nothing to measure")
    seq, ticks = np.array([_seq_and_ticks(arrival.head) for arrival in arrivals], np.int64).T
    last_gate = np.minimum(np.searchsorted(gates.board_ticks, ticks), len(gates.board_ticks) - 1)
    if unknown := np.count_nonzero(gates.board_ticks[last_gate] != ticks):
        raise ValueError(f"{unknown} of {len(arrivals)} messages describe gates that the truth does not have")
    came_ns = np.array([arrival.t_ns for arrival in arrivals], np.int64)
    windows = (last_gate[-1] - last_gate[0]) // gates_apart + 1
    made = int(seq[-1] - seq[0]) + 1
    return Latency((came_ns - gates.end_ns[last_gate]) * 1e-6, made - len(arrivals), int(windows) - made)


def _seq_and_ticks(head: bytes) -> tuple[int, int]:
    """Read JSON, which is whole, or CBOR, which may be cut off."""
    if head.startswith(b"{"):
        message = json.loads(head)
        return message["seq"], int(message["board_ticks"])
    decoder = cbor2.CBORDecoder(BytesIO(head[1:]))  # behind the head of a map of up to 23 pairs of key and value
    found: dict[str, Any] = {}
    while "board_ticks" not in found:
        key = decoder.decode()
        found[key] = decoder.decode()
    return found["seq"], found["board_ticks"]
