"""A daemon's status as tests of its socket, its metrics and its pages need one."""

import socket
from pathlib import Path
from typing import Any

from example_messages import NOW_NS, header

from resonator_daemon.daemon.monitoring.status import BrokerStatus, ConfigStatus, Status
from resonator_daemon.mqtt.payloads import (
    BootInfo,
    Condition,
    Health,
    LatencyInfo,
    Lost,
    MessageAccount,
    OutageInfo,
    RecordingInfo,
    State,
)

HEADER = header(seq=3, board_boot_id="51aa03c4", t_uncertainty_ns=0)
LOST = Lost(
    link_gap=1, damaged=2, board_overflow=3, host_overrun=4, queue_overflow=5, publish_dropped=6, skipped_late=7
)
RECORDING = RecordingInfo(
    file="/rec/hand.mcap", since_t_ns=NOW_NS - 30_000_000_000, failure=None, file_bytes=38_000_000, files=39,
    files_removed=40, events_missing=41, messages=42, messages_missing=43
)  # fmt: skip
NOTHING = {"file": None, "since_t_ns": None, "failure": None}
NOT_RECORDING = RecordingInfo(**(dict.fromkeys(RECORDING.model_fields_set, 0) | NOTHING))


def ago_ns(seconds: float) -> int:
    return NOW_NS - round(seconds * 1e9)


def state(word: Condition, reason: str = "", *, for_s: float = 60.0, **more: Any) -> State:
    return State(**HEADER | {"lost": LOST}, state=word, reason=reason, since_t_ns=ago_ns(for_s), **more)


def health(**changed: Any) -> Health:
    fields: dict[str, Any] = {
        "uptime_s": 3600.0,
        "frames": 3_600_000,
        "frame_rate_hz": 999.6,
        "parts_lost": 7,
        "frames_not_decoded": 8,
        "records_unusable": {"edges": 9},
        "decoder": {
            "pid": 4711, "restarts": {"hung": 46}, "decoded": 47, "skipped": {"too_old": 8}, "waiting": 0,
            "cpu_percent": 48.0, "rss_mb": 49.0
        },
        "packets_ignored": {"stale": 10, "malformed": 11, "unknown": 12, "log": 13},
        "bytes_in": 11_111,
        "bytes_by_outcome": {"accepted": 10_000, "other_version": 1000, "echo": 100, "discarded": 10, "waiting": 1},
        "connections": 14,
        "host_overruns": 15,
        "boots": (
            BootInfo(
                board_boot_id="51aa03c4", connections=14, frames=3_600_000, lost={"link_gap": 1}, lost_in_outages={}
            ),
        ),
        "clock_drift_ppm": 3.25,
        "clock_outliers": 16,
        "clock_restarts": 17,
        "cpu_percent": 12.5,
        "rss_mb": 96.0,
        "tasks": 18,
        "threads": 19,
        "file_descriptors": 20,
        "latency": {"forces": LatencyInfo(bounds_ms=(0.5, 2.0, 1000.0), counts=(21, 22, 23, 24))},
        "recording": RECORDING,
        "commands": {"done": 25, "not_permitted": 26},
        "messages": MessageAccount(
            enqueued=240,
            republished=27,
            resent=28,
            recovered=29,
            acknowledged=30,
            written=31,
            dropped={"no_connection": 32, "spool_full": 33},
            unknown_at_disconnect=34,
            waiting=80,
            spooled=36,
        ),
    }  # fmt: skip
    return Health(**HEADER | {"lost": LOST}, **fields | changed)


def status(**changed: Any) -> Status:
    fields: dict[str, Any] = {
        "name": "left-index",
        "instance": "hand",
        "pid": 4711,
        "version": "0.1.0",
        "started_t_ns": ago_ns(3600),
        "config": ConfigStatus(file="/etc/resonatord/hand.toml", in_use="file", loaded_t_ns=ago_ns(3600)),
        "daemon": state(Condition.ONLINE, "measuring", for_s=3600, connections=2, connected_t_ns=ago_ns(300)),
        "link": state(Condition.ONLINE, "board 0042 sends 1000 frames/s", boot_count=35),
        "sensor": state(Condition.DRIFTING, "slowly"),
        "health": health(),
        "broker": BrokerStatus(url="mqtt://127.0.0.1:1883", connected=True),
        "recording": RECORDING,
        "ages_s": {
            "started": 3600.0, "config": 3500.0, "daemon": 3400.0, "link": 3300.0, "sensor": 3200.0,
            "outage": 3310.0, "connected": 300.0, "recording": 30.0
        },
    }  # fmt: skip
    return Status(**fields | changed)


def outage() -> OutageInfo:
    return OutageInfo(start_t_ns=ago_ns(90), end_t_ns=ago_ns(88.5), frames_lost=1500, reason="unplugged")


def listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as asking:
        return asking.connect_ex(str(path)) == 0
