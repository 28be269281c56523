"""A plate on the network as its messages describe it, and the counters of its signals."""

import json
import math
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import Prior, Skin
from resonator_daemon.measure.sensors.surface_worker import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.codec import decode
from resonator_daemon.mqtt.payloads import Condition, DecoderPlateHealth, Info, Measured, Signals, Status
from resonator_daemon.mqtt.topics import DECODED, SCHEMA_VERSION, HeaderFields

NO_INFO = Reason(ReasonCode.NO_INFO, "no info yet: no daemon has published under this name")
DECODED_BY_DAEMON = Reason(
    ReasonCode.DECODED_BY_DAEMON,
    "the daemon decodes this plate itself; set external = true in [decoding] of its configuration",
)
NO_SIGNALS = Reason(ReasonCode.NO_SIGNALS, "no signals that could be decoded")
SITES_MAX: Final = 10_000
INFO_BYTES_MAX: Final = 2_000_000
WAITS_AFTER_S: Final = 2.0  # without signals, a decoder is waiting

_REASON_MAX = 200  # characters of an error that become part of a state

_INT64 = range(2**63)  # what subscribers hold numbers in
_NS = 1_000_000_000


MakeSettings = Callable[..., SurfaceSettings]


class RemotePlate:
    """Reads what a plate publishes; what cannot be read is counted, nothing raises.

    Parameters
    ----------
    name
    make_settings
        Called with skin, site_ids and pitch_m.

    Attributes
    ----------
    name
    settings
        Of a decoder, by the last `info`; None where that is missing, unreadable, or of a plate that cannot be decoded.
    problem
        Why there is none; None where there is one.
    received
        Messages on `signals`.
    unusable
        Of those: not a message, not of this skin, or not good enough to be decoded.
    missed
        Gaps in `seq` while the daemon stayed the same.
    decoded, skipped
        Of the usable ones: published; given up for a newer one, or not decoded for another reason.
    last_s
        When signals came last that could be used, by the monotonic clock.
    gate_s
        Length of a frame's gate, by the last `info` that could be used.
    is_decoded
        Whether a decoder is set up for the present skin.
    note, is_refused
        What is being set up, or with `is_refused` why the skin cannot be decoded.
    """

    def __init__(self, name: str, make_settings: MakeSettings) -> None:
        self.name = name
        self._make_settings = make_settings
        self.settings: SurfaceSettings | None = None
        self.problem: Reason | None = NO_INFO
        self.received = self.unusable = self.missed = self.decoded = self.skipped = 0
        self.last_s = -math.inf
        self.gate_s = 0.0
        self.is_decoded = self.is_refused = False
        self.note: Reason | None = None
        self._last: tuple[str, int] | None = None  # boot of the daemon, seq

    def read_info(self, payload: bytes) -> bool:
        """Read an `info`, or b"" where it was taken back; returns whether the skin is another one now."""
        before = self.settings
        try:
            self.settings, self.gate_s = _read_info(payload, self._make_settings)
        except _UnusableInfoError as error:
            self.settings, self.problem = None, error.reason
            return before is not None
        self.problem = None
        if before is None or not _is_same(self.settings, before):
            return True
        self.settings = before
        return False

    def refuse(self, problem: Reason) -> None:
        """Decode nothing until the next `info`."""
        self.settings, self.problem = None, Reason(problem.code, problem.text[:_REASON_MAX])

    def read_signals(self, payload: bytes) -> Signals | None:
        """Read a `signals`; None where it cannot be decoded, which is counted."""
        self.received += 1
        try:
            message = decode(Signals, payload)
        except (ValueError, RecursionError, MemoryError, OverflowError):
            self.unusable += 1
            return None
        if not all(
            number in _INT64 for number in (message.seq, message.t_uncertainty_ns, *message.lost.model_dump().values())
        ):
            self.unusable += 1
            return None
        self._follow(message)
        sites = len(self.settings.site_ids) if self.settings else 0
        usable = message.status is Status.OK and message.signals.shape == message.noise_std.shape == (3, sites)
        if not usable or not self.settings:
            self.unusable += 1
            return None
        self.last_s = time.monotonic()
        return message

    @property
    def waiting(self) -> int:
        """Number of frames that are being decoded, or wait."""
        return 0

    def health(self) -> DecoderPlateHealth:
        """Return the counters of its signals."""
        return DecoderPlateHealth(**{key: getattr(self, key) for key in DecoderPlateHealth.model_fields})

    def condition(self) -> tuple[Condition, Reason]:
        """Return the present state and its reason."""
        if self.problem:
            return Condition.WAITING, self.problem
        if self.note:
            return (Condition.REFUSED if self.is_refused else Condition.STARTING), self.note
        if not self.is_decoded or time.monotonic() - self.last_s > WAITS_AFTER_S:
            return Condition.WAITING, NO_SIGNALS
        return Condition.ONLINE, Reason(ReasonCode.DECODING, "signals are decoded")

    def age_s(self, message: Signals) -> float:
        """Return the time from the end of a frame's gate until now, as far as this computer's clock and its agree."""
        return (time.time_ns() - message.t_ns) / _NS - self.gate_s / 2

    def _follow(self, message: Signals) -> None:
        if self._last is not None and self._last[0] == message.daemon_boot_id:
            self.missed += max(message.seq - self._last[1] - 1, 0)
            if message.seq < self._last[1]:
                return
        self._last = message.daemon_boot_id, message.seq


def header_of(message: Signals) -> HeaderFields:
    """Return the header for what is decoded of these signals: it belongs to the same instant and has the same `seq`."""
    return {key: getattr(message, key) for key in Measured.model_fields}


def frame_of(message: Signals) -> SurfaceFrame:
    """Return the frame for the decoder, from a message of signals."""
    header = header_of(message)
    signals, noise_std = message.signals.astype(np.float64), message.noise_std.astype(np.float64)
    return SurfaceFrame(header, header["seq"], signals, noise_std)


def error_text(error: BaseException) -> str:
    """Return the text of an error; some, as of memory, have none."""
    return str(error) or repr(error)


class _UnusableInfoError(ValueError):
    """Why there is nothing to decode."""

    def __init__(self, text: str, code: ReasonCode = ReasonCode.INFO_UNUSABLE) -> None:
        super().__init__(text)
        self.reason = Reason(code, text)


def _read_info(payload: bytes, make_settings: MakeSettings) -> tuple[SurfaceSettings, float]:
    """Read the settings of a decoder and the length of a gate from an `info`."""
    if not payload:
        raise _UnusableInfoError(NO_INFO.text, NO_INFO.code)
    try:
        _check_size(payload)
        info = decode(Info, payload)
    except _UnusableInfoError:
        raise
    except (ValueError, RecursionError, MemoryError, OverflowError) as error:
        first = error_text(error).splitlines()[0][:_REASON_MAX]
        raise _UnusableInfoError(f"info cannot be read: {first}") from error
    if (version := info.schema_version).partition(".")[0] != SCHEMA_VERSION.partition(".")[0]:
        reads = f"this decoder reads {SCHEMA_VERSION}"
        raise _UnusableInfoError(f"its messages have schema version {version[:20]!a}, {reads}")
    if DECODED.path in info.rates_hz:
        raise _UnusableInfoError(DECODED_BY_DAEMON.text, DECODED_BY_DAEMON.code)
    if not info.skin:
        raise _UnusableInfoError("has no skin to decode; waits for another plate of this name")
    positions_m = np.array([site.position_m for site in info.sites], np.float64).reshape(-1, 2)
    try:
        half_space = HalfSpace(info.skin.youngs_modulus_pascal, info.skin.poisson_ratio)
        prior = Prior(info.skin.correlation_length_m, info.skin.tangential_ratio)
    except ValueError as error:
        raise _UnusableInfoError(f"skin in info: {error_text(error)}") from error
    skin = Skin(half_space, positions_m, info.skin.depth_m, info.skin.gain_std, prior)
    if problem := _problem(info, skin):
        raise _UnusableInfoError(f"info: {problem}")
    site_ids = np.array([site.site for site in info.sites], np.intp)
    settings = make_settings(skin=skin, site_ids=site_ids, pitch_m=info.grid.pitch_m if info.grid else None)
    return settings, 1 / info.frame_rate_hz


def _is_same(one: SurfaceSettings, other: SurfaceSettings) -> bool:
    return (
        one.skin.geometry() == other.skin.geometry()
        and one.pitch_m == other.pitch_m
        and np.array_equal(one.site_ids, other.site_ids)
    )


def _check_size(payload: bytes) -> None:
    """Refuse what is too long to be checked entry by entry on the event loop."""
    if len(payload) > INFO_BYTES_MAX:
        raise _UnusableInfoError(f"info has {len(payload)} bytes, a decoder reads {INFO_BYTES_MAX} at most")
    content = json.loads(payload)
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    for key, value in content.items():
        if isinstance(value, list | dict) and len(value) > SITES_MAX:
            what = f"{len(value)} entries in {key[:20]!a}"
            raise _UnusableInfoError(f"info has {what}, a decoder takes {SITES_MAX} sites at most")


def _problem(info: Info, skin: Skin) -> str | None:
    """Return why no decoder can be built, None if one can; errors of building itself come later."""
    if not len(skin.site_positions_m):
        return "no sites"
    if not np.isfinite(skin.site_positions_m).all():
        return "sites without a place"
    if not all(site.site in _INT64 for site in info.sites):
        return "numbers of sites must be in 0 .. 2^63 - 1"
    if not 1e-9 < info.frame_rate_hz < math.inf:
        return f"frame_rate_hz is {info.frame_rate_hz}, must be above 0"
    if not 0.0 < skin.depth_m < np.inf or not 0.0 <= skin.gain_std < 1.0:
        return f"depth {skin.depth_m} m must be above 0, gain_std {skin.gain_std} in 0 .. 1"
    return None
