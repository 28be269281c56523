"""What decoders share: what they return, limits by which a frame is judged, and checks of parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.base.reasons import Reason

SIGNAL_LIMIT = 10.0  # a strain of ten: far beyond linear elasticity, only damage produces it
KNOWN_LIMIT = 0.5  # smallest share of known signals
CHI2_LIMIT = 100.0  # residual of ten times the declared noise ...
UNEXPLAINED_LIMIT = 0.5  # ... and of half the frame's energy: no load on a half-space makes such signals
GAIN_FLOOR = 1.5  # standard deviations of the gain that count as noise of the signals' rms


def check_gain(gain_std: float) -> None:
    """Refuse what is no relative standard deviation of gains."""
    if not 0.0 <= gain_std < 1.0:
        raise ValueError(f"gain_std is {gain_std}, must be at least 0 and below 1")


def positions(name: str, positions_m: ArrayLike) -> Floats:
    """Return the places (n, 2), at least one."""
    places = np.asarray(positions_m, np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise ValueError(f"{name} has shape {places.shape}, must be (n, 2), n at least 1")
    if not np.isfinite(places).all():
        raise ValueError(f"{name} holds {np.abs(places).max()}, must be finite")
    return places


def noise_of_signals(noise_std: ArrayLike, sites: tuple[int, ...]) -> Floats:
    """Broadcast to (3, *sites) what is given for all signals, by channel (3,), or for each."""
    std = np.asarray(noise_std, np.float64)
    by_channel = std.reshape(3, *[1] * len(sites)) if std.shape == (3,) else std
    return positive("noise_std", by_channel, (3, *sites))


def positive(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Broadcast values to a shape; ValueError where that cannot be, or for one that is not finite and above 0."""
    given = np.asarray(values, np.float64)
    try:
        whole = np.broadcast_to(given, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {given.shape}, must broadcast to {shape}") from None
    if not ((whole > 0.0) & (whole < np.inf)).all():
        raise ValueError(f"{name} spans {whole.min()} .. {whole.max()}, must be finite and above 0")
    return whole


@dataclass(frozen=True)
class Decoded:
    """One decoded frame, or a stack of them: leading axes of the signals are leading axes here.

    Components are x, y, z; a traction is what the object exerts: f_z > 0 presses; u_z > 0 is indentation.
    If `status` is neither "ok" nor "constraint_dropped", the surface's numbers are NaN, with the cause in `reason`.
    "constraint_dropped": contact physics did not fit the signals, and `reason` names what is shown in its place.
    """

    traction_pascal: Floats  # (..., 3, ny, nx) or (..., 3, m)
    traction_std_pascal: Floats  # of the same shape
    displacement_m: Floats | None  # of the same shape, where asked for
    border_contact: bool | Bools  # (...): the load reaches the border, expect errors there
    log_evidence: float | Floats  # (...): log density of the signals under the decoder's model
    chi2: float | Floats  # (...): about 1 where signals scatter by the model and the declared noise
    status: str | NDArray[np.str_]  # (...)
    reason: str | NDArray[np.str_]  # (...): a sentence, empty where there is none
    reason_code: str | NDArray[np.str_] = ""  # (...): a `ReasonCode` for programs, empty where there is none

    @classmethod
    def stack(cls, frames: Sequence[Self], leading: tuple[int, ...], shape: tuple[int, ...]) -> Self:
        """Single frames, of surface arrays of `shape`, in row order of the `leading` axes."""

        def joined(name: str, each: tuple[int, ...], dtype: DTypeLike) -> Any:
            return np.array([getattr(frame, name) for frame in frames], dtype).reshape(*leading, *each)

        has_displacement = bool(frames) and frames[0].displacement_m is not None
        return cls(
            joined("traction_pascal", shape, np.float64),
            joined("traction_std_pascal", shape, np.float64),
            joined("displacement_m", shape, np.float64) if has_displacement else None,
            joined("border_contact", (), np.bool_),
            joined("log_evidence", (), np.float64),
            joined("chi2", (), np.float64),
            joined("status", (), np.str_),
            joined("reason", (), np.str_),
            joined("reason_code", (), np.str_),
        )

    @classmethod
    def unknown(
        cls,
        shape: tuple[int, ...],
        displacement: bool,
        log_evidence: float,
        chi2: float,
        status: str,
        why: Reason | None,
    ) -> Self:
        """Return one frame of which no surface is known, with arrays of `shape`."""
        traction, std, moved = np.full((3, *shape), np.nan)
        text, code = stated(why)
        return cls(traction, std, moved if displacement else None, False, log_evidence, chi2, status, text, code)


def stated(reason: Reason | None) -> tuple[str, str]:
    """Return `Decoded.reason` and `Decoded.reason_code`."""
    return (reason.text, reason.code) if reason is not None else ("", "")
