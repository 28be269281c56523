"""One whole message of each topic and command, as the AsyncAPI document and docs/reference/mqtt-topics.md show them."""

import json
from types import NoneType
from typing import Any, Final, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel

from resonator_daemon.mqtt.codec import encode, read_arrays
from resonator_daemon.mqtt.payload_types import UNITS
from resonator_daemon.mqtt.payloads import WITH_ARRAYS, ContactEvent, Grid, Message
from resonator_daemon.mqtt.topics import DECODER_HEALTH, DECODER_STATE, SCHEMA_VERSION, TOPICS
from resonator_daemon.mqtt.verbs import VERBS, Refusal

# Value of each key in all messages, or in one model. A key without one has the value of what has not happened.
_NO_FRAMES: Final = dict.fromkeys(("link_gap", "damaged", "board_overflow", "host_overrun", "queue_overflow"), 0)
_VALUES: Final[dict[str, Any]] = {
    "name": "left-index",
    "seq": 1234,
    "daemon_boot_id": "9f3c52d0",
    "board_boot_id": "51aa03c4",
    "t_ns": 1789000000000000000,
    "t_uncertainty_ns": 42000,
    "since_t_ns": 1788999999000000000,
    "board_ticks": 123456789,
    "status": "ok",
    "window_s": 0.01,
    "step_s": 0.005,
    "site": 7,
    "force_newton": [None, None, 1.234],
    "noise_newton": [None, None, 0.0006],
    "SiteForce.force_newton": 1.234,
    "SiteForce.noise_newton": 0.0006,
    "systematic_newton": [None, None, 0.038],
    "SiteForce.systematic_newton": 0.038,
    "peak_newton": 1.31,
    "corners": [
        {"captured": "site", "site": 7, "frequency_hz": 9991643.336, "noise_hz": 0.0247, "residual": -0.46},
        {"captured": "site", "site": 7, "frequency_hz": 9992048.305, "noise_hz": 0.024, "residual": -0.47},
        {"captured": "site", "site": 7, "frequency_hz": 9991728.986, "noise_hz": 0.0241, "residual": 0.5},
        {
            "captured": "none",
            "site": None,
            "frequency_hz": None,
            "noise_hz": None,
            "residual": None,
            "reason_code": "channels_silent",
        },
    ],
    "common_mode": [-1.5e-06, -1.5e-06, -1.5e-06, -1.5e-06],
    "SiteForce.unobserved_bound_newton": 5.9,
    "id": 12,
    "SiteInfo.site": 1,
    "SiteInfo.position_m": [-0.0061, 0.0042],
    "position_m": [0.0012, -0.0034],
    "position_covariance_m2": [4.2e-07, 0.0, 4.2e-07],
    "duration_s": 1.4,
    "ContactEvent.event": "release",
    "ContactEvent.reason_code": "force_fell",
    "ContactEvent.reason": "below 0.01 N",
    "EventContact.force_newton": [None, None, 0.008],
    "DecodedSummary.decoder": "open-plane+contact",
    "FitQuality.chi2": 1.02,
    "area_m2": 1.9e-05,
    "area_std_m2": 4e-08,
    "radius_of_curvature_m": 0.0056,
    "radius_of_curvature_std_m": 1.3e-05,
    "stick_ratio": 0.58,
    "stick_ratio_std": 0.01,
    "State.state": "waiting",
    "State.reason_code": "no_such_port",
    "State.reason": "no port /dev/ttyACM0; no serial port is present",
    "schema_version": SCHEMA_VERSION,
    "daemon_version": "0.1.0",
    "plate": "quartz16",
    "link": "serial:/dev/ttyACM0?baud=4000000",
    "product": "resonator board",
    "serial_number": "0042",
    "firmware": "1.2.0",
    "counter": "single-tone",
    "frame_rate_hz": 1000.0,
    "rates_hz": {"forces": 200.0, "forces/20hz": 20.0, "contacts": 200.0, "contacts/20hz": 20.0, "tones": 20.0},
    "units": UNITS,
    "Info.commands": ["ping", "events", "tare"],
    "force_max_newton": 10.0,
    "codes": [
        {
            "site": 1,
            "f0_hz": [9975893.1, 9976187.1, 9976124.2, 9975900.2],
            "full_load_hz": [9975076.141, 9975370.117, 9975307.222, 9975083.241],
        },
    ],
    "pilot_hz": 10010000.0,
    "outline_m": [[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]],
    "transducers_m": [[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]],
    "CalibrationInfo.id": "a09f9fdde0d1570b",
    "date": "2026-11-21",
    "unit": "0042",
    "expiry": "2027-11-21",
    "model_error": 0.012,
    "sensitivity_std": 0.001,
    "CalibrationInfo.response": "on",
    "uptime_s": 60.2,
    "frames": 60000,
    "packets_ignored": dict.fromkeys(("stale", "malformed", "unknown", "log"), 0),
    "bytes_in": 12240312,
    "bytes_by_outcome": {"accepted": 12240210, "other_version": 0, "echo": 0, "discarded": 0, "waiting": 102},
    "Health.connections": 1,
    "BootInfo.connections": 1,
    "BootInfo.lost": _NO_FRAMES,
    "BootInfo.lost_in_outages": _NO_FRAMES,
    "clock_drift_ppm": 3.1,
    "cpu_percent": 21.0,
    "processor_wait_percent": 38.0,
    "rss_mb": 92.0,
    "tasks": 9,
    "threads": 4,
    "file_descriptors": 23,
    "Health.latency": {"forces": {"bounds_ms": [1.0, 2.0, 10.0], "counts": [2100, 9300, 640, 0]}},
    "RecordingInfo.since_t_ns": None,
    "RecordingInfo.files": 2,
    "RecordingInfo.messages": 412,
    "Health.commands": {"done": 3, "not_permitted": 1},
    "enqueued": 24016,
    "acknowledged": 22,
    "written": 23986,
    "dropped": {"no_connection": 5, "superseded": 1},
    "MessageAccount.waiting": 2,
    "DecoderState.state": "online",
    "DecoderState.reason_code": "decoding",
    "DecoderState.decoder_id": "bench-4711",
    "DecoderHealth.decoder_id": "bench-4711",
    "topic_filter": "resonator/left-index/signals",
    "DecoderHealth.cpu_percent": 97.0,
    "DecoderHealth.plates": {
        "left-index": {"received": 3010, "decoded": 2998, "skipped": 10, "unusable": 0, "waiting": 2, "missed": 0}
    },
    "DecoderHealth.latency": {"decoded": {"bounds_ms": [2.0, 5.0, 10.0], "counts": [0, 2710, 260, 28]}},
}

# Numbers that float32 holds exactly: of four sites, and a map of 2 x 2 pixels.
_ARRAY_VALUES: Final[dict[str, Any]] = {
    "Signals.signals": np.multiply.outer([4.0, 1.0, -1.0], [0.125, 0.25, 0.5, 1.0]) / 1024,
    "Signals.noise_std": np.full((3, 4), 2.0**-15),
    "traction_pascal": np.multiply.outer([128.0, 0.0, 1024.0], [[0.5, 1.0], [2.0, 4.0]]),
    "traction_std_pascal": np.full((3, 2, 2), 64.0),
    "Decoded.grid": Grid(origin_m=(-0.0002, -0.0002), pitch_m=0.0004),
}
_COMMAND_VALUES: Final[dict[str, Any]] = {
    "Request.id": "1f9c",
    "Answer.id": "1f9c",
    "Refusal.id": "1f9c",
    "Events.after_seq": 1233,
    "EventsAnswer.complete": True,
    "EventsAnswer.oldest_seq": 0,
    "EventsAnswer.newest_seq": 1234,
    "StartRecording.label": "drop",
    "Mark.text": "new fingertip",
    "SetWindow.window_ms": 20.0,
    "SetWindow.step_ms": 10.0,
    "TareAnswer.message": "the present readings are the new zero",
    "file": "/var/lib/resonatord/recordings/left-index-20261122T101500.250Z-drop.mcap",
    "RecordingInfo.file": None,
    "StopRecordingAnswer.recording": {
        "file": "/var/lib/resonatord/recordings/left-index-20261122T101500.250Z-drop.mcap",
        "files": 1,
        "all_bytes": 1250304,
        "events": 41230,
        "events_missing": 0,
        "duration_s": 12.5,
        "failure": None,
    },
    "Refusal.verb": "tare",
    "Problem.code": "not_untouched",
    "Problem.message": "sites are touched",
    "Problem.hint": "take everything off the plate and retry",
}

# The contact of the examples is on a force site.
_OF_SKINS: Final = {
    *("slip_margin", "slip_margin_std", "slip_margin_systematic", "friction_coefficient"),
    *("friction_coefficient_std", "friction_coefficient_systematic"),
}

ModelT = TypeVar("ModelT", bound=BaseModel)


def _example(kind: type[ModelT]) -> ModelT:
    """Return a message with a value for each key of a model."""
    return kind.model_validate({key: _value(kind, key) for key in kind.model_fields if key not in _OF_SKINS})


def _value(kind: type[BaseModel], key: str) -> Any:
    values = _VALUES | _ARRAY_VALUES | _COMMAND_VALUES
    for name in (*(f"{base.__name__}.{key}" for base in kind.__mro__), key):
        if name in values:
            return values[name]
    annotation: Any = kind.model_fields[key].annotation
    parts = get_args(annotation)
    if NoneType in parts:
        return None
    if get_origin(annotation) is Literal:
        return parts[0]
    if parts and get_origin(annotation) is tuple and issubclass(parts[0], BaseModel):
        return (_example(parts[0]),)
    empty = get_origin(annotation) or annotation
    return _example(empty) if issubclass(empty, BaseModel) else empty()


def _json(message: BaseModel, *, exclude_none: bool = False, **change: Any) -> dict[str, Any]:
    fields: dict[str, Any] = json.loads(message.model_copy(update=change).model_dump_json(exclude_none=exclude_none))
    return fields


def _with_rows(kind: type[Message]) -> dict[str, Any]:
    """Return the fields of a CBOR message with arrays as nested rows."""
    fields = read_arrays(encode(_example(kind)))
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in fields.items()}


_COMMAND_VALUES["EventsAnswer.events"] = (_example(ContactEvent).model_copy(update={"replayed": True}),)

_KINDS: Final = [*(topic.payload for topic in TOPICS.values()), DECODER_STATE.payload, DECODER_HEALTH.payload]
_ANSWERS: Final[list[type[BaseModel]]] = [*(verb.answer for verb in VERBS.values()), Refusal]

Examples = dict[str, dict[str, Any]]
EXAMPLES: Final[Examples] = {kind.__name__: _json(_example(kind)) for kind in _KINDS if kind not in WITH_ARRAYS}
ARRAY_EXAMPLES: Final[Examples] = {kind.__name__: _with_rows(kind) for kind in WITH_ARRAYS}
REQUEST_EXAMPLES: Final[Examples] = {
    verb.request.__name__: _json(_example(verb.request), exclude_none=True) for verb in VERBS.values()
}
ANSWER_EXAMPLES: Final[Examples] = {kind.__name__: _json(_example(kind)) for kind in _ANSWERS}
