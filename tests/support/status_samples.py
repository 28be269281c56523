"""A daemon's status as tests of its socket, its metrics and its pages need one."""

import json
import socket
from pathlib import Path
from typing import Any

from example_messages import NOW_NS, header

from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.mqtt.payloads import Condition, Health, Lost, OutageInfo, RecordingInfo, State

SAMPLE = json.loads(Path(__file__).with_name("status_sample.json").read_text())
HEADER = header(seq=3, board_boot_id="51aa03c4", t_uncertainty_ns=0)
LOST = Lost(**SAMPLE["lost"])
RECORDING = RecordingInfo(**SAMPLE["recording"])
NOTHING = {"file": None, "since_t_ns": None, "failure": None}
NOT_RECORDING = RecordingInfo(**(dict.fromkeys(RECORDING.model_fields_set, 0) | NOTHING))


def ago_ns(seconds: float) -> int:
    return NOW_NS - round(seconds * 1e9)


def state(word: Condition, reason: str = "", *, for_s: float = 60.0, **more: Any) -> State:
    return State(**HEADER | {"lost": LOST}, state=word, reason=reason, since_t_ns=ago_ns(for_s), **more)


def health(**changed: Any) -> Health:
    return Health(**HEADER | {"lost": LOST, "recording": RECORDING} | SAMPLE["health"] | changed)


def status(**changed: Any) -> Status:
    fields: dict[str, Any] = {
        "daemon": state(Condition.ONLINE, "measuring", for_s=3600, connections=2, connected_t_ns=ago_ns(300)),
        "link": state(Condition.ONLINE, "board 0042 sends 1000 frames/s", boot_count=35),
        "sensor": state(Condition.DRIFTING, "slowly"),
        "health": health(),
        "recording": RECORDING,
    }
    return Status(**SAMPLE["status"] | fields | changed)


def outage() -> OutageInfo:
    return OutageInfo(start_t_ns=ago_ns(90), end_t_ns=ago_ns(88.5), frames_lost=1500, reason="unplugged")


def listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as asking:
        return asking.connect_ex(str(path)) == 0
