"""Adjacent gates of a channelised counter merged to the frequency of the whole window.

A gate's mid-phase and slope are what a regression of phase on time leaves of it. Under white phase noise they are
uncorrelated, the slope with the standard deviation s in hertz and the mid-phase with s T / sqrt(12) in turns, T the
gate. So the regression over k gates has all it needs: information 1 / s^2 from each slope and 12 x^2 / s^2 from each
mid-phase, x gates off the middle. Together that is k^3 / s^2, where the mean of the offsets has k / s^2.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats

SIGMA_HZ: Final[Floats] = np.exp2((np.arange(256) - 128) / 8)  # by sigma_code
TURN32: Final = 2.0**32  # units of phase in a turn
HERTZ16: Final = 2.0**16  # units of offset in a hertz
NOISE_SIGMAS: Final = 6.0
HALF_TURN: Final = 0.5  # phases that may be off by more leave the count of turns in doubt
RESIDUE_TURN_MAX: Final = 0.25
# Of a window's range of offsets: two gates' mean is off by less from that between their middles.
CHIRP_SHARE: Final = 0.25


class MergedTones(NamedTuple):
    """Offsets of the tones over the window and their standard deviation, NaN where no gate is known; shape as a gate's.

    `resync` marks where the phases did not run on, so that the offset is the mean of the gates' own.
    """

    offset_hz: Floats
    sigma_hz: Floats
    resync: NDArray[np.bool_]


def merge_tones(
    phase_turn32: NDArray[np.integer],
    offset_hz16: NDArray[np.integer],
    sigma_hz: Floats,
    known: NDArray[np.bool_],
    gate_s: float,
) -> MergedTones:
    """Merge k adjacent gates by regression of phase on time, each gate by its own noise.

    Parameters
    ----------
    phase_turn32, offset_hz16
        (k, ...), as the records have them: at mid-gate in 2^-32 turn, and in 2^-16 Hz.
    sigma_hz
        (k, ...), standard deviation of each offset; it limits how far phases may be off the offsets' prediction.
    known
        (k, ...); gates that are not known stay out, the phase runs on across them.
    gate_s
        From one gate's middle to the next one's, too.
    """
    shape = phase_turn32.shape
    if not shape or not shape[0] or {offset_hz16.shape, sigma_hz.shape, known.shape} != {shape}:
        raise ValueError(
            f"phase_turn32 {shape} must be (k, ...) with k > 0, and so offset_hz16 {offset_hz16.shape}, "
            f"sigma_hz {sigma_hz.shape}, known {known.shape}"
        )
    if not gate_s > 0.0:
        raise ValueError(f"gate_s {gate_s} must be above 0")
    offset_hz = offset_hz16 / HERTZ16
    weight = np.where(known, 1.0 / sigma_hz**2, 0.0)
    turns, broken = _unwrap(phase_turn32, offset_hz16, sigma_hz, known, gate_s)
    gates = np.arange(len(known), dtype=np.float64).reshape(-1, *[1] * (known.ndim - 1))
    with np.errstate(invalid="ignore"):  # 0 / 0 where no gate is known
        total = weight.sum(axis=0)
        mean_hz = (weight * offset_hz).sum(axis=0) / total
        lever = weight * (gates - (weight * gates).sum(axis=0) / total)
        spread = (lever * gates).sum(axis=0)
        merged_hz = (total * mean_hz + 12.0 * (lever * turns).sum(axis=0) / gate_s) / (total + 12.0 * spread)
        information = np.where(broken, total, total + 12.0 * spread)
        information = np.where(information > 0.0, information, np.nan)
    return MergedTones(np.where(broken, mean_hz, merged_hz), 1.0 / np.sqrt(information), broken)


def _unwrap(
    phase_turn32: NDArray[np.integer],
    offset_hz16: NDArray[np.integer],
    sigma_hz: Floats,
    known: NDArray[np.bool_],
    gate_s: float,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the turns since the first known gate (k, ...), and where the phases did not run on.

    Turns between known gates are counted by the mean of their offsets, in integers modulo 2^32.
    """
    low, high = (np.where(known, offset_hz16, edge) for edge in (np.iinfo(np.int64).max, np.iinfo(np.int64).min))
    chirp_hz = CHIRP_SHARE / HERTZ16 * np.where(known.any(axis=0), high.max(axis=0) - low.min(axis=0), 0)
    turns32 = np.zeros(known.shape, np.int64)
    last = np.zeros((4, *known.shape[1:]), np.int64)  # gate, phase, offset and turns of the last known gate
    last_variance, seen, broken = (np.zeros(known.shape[1:], kind) for kind in (np.float64, bool, bool))
    for index, here in enumerate(known):
        gates = index - last[0]
        expected = np.rint((offset_hz16[index] + last[2]) * (gates * (gate_s * HERTZ16 / 2.0))).astype(np.int64)
        residue = (phase_turn32[index] - last[1] - expected).astype(np.int32)  # the lowest 32 bits, with their sign
        variance = sigma_hz[index] ** 2
        noise = NOISE_SIGMAS * gate_s * np.sqrt((variance + last_variance) * (1.0 / 12.0 + gates**2 / 4.0))
        allowed = np.minimum(noise + chirp_hz * gates * gate_s, RESIDUE_TURN_MAX)
        broken |= here & seen & ((np.abs(residue / TURN32) > allowed) | (noise > HALF_TURN))
        turns32[index] = last[3] + np.where(seen, expected + residue, 0)
        last = np.where(
            here, np.stack([np.full_like(gates, index), phase_turn32[index], offset_hz16[index], turns32[index]]), last
        )
        last_variance = np.where(here, variance, last_variance)
        seen = seen | here
    return turns32 / TURN32, broken
