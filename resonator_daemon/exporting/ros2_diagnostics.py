"""States and health of plates as diagnostics of ROS 2."""

from collections.abc import Mapping
from typing import Any, Final

from resonator_daemon.exporting.mcap_output import OK, WARN, severity, state_text
from resonator_daemon.exporting.ros2_types import DIAGNOSTICS, Typestore, ros_name
from resonator_daemon.publishing.payloads import Health, State
from resonator_daemon.publishing.topics import HEALTH

STALE: Final = 3  # as diagnostic_msgs/DiagnosticStatus counts


class Diagnostics:
    """Translation of one plate's states and health to statuses.

    Parameters
    ----------
    name
        Name that the plate is published under.
    store
        Types of the messages.
    """

    def __init__(self, name: str, store: Typestore) -> None:
        self._name = name
        self._types = store.types

    def of_state(self, path: str, state: State) -> Any:
        """Return the status of daemon, link or sensor."""
        values = {"state": state.state, "reason_code": state.reason_code, "since_t_ns": state.since_t_ns}
        return self._status(path, severity(state.state), state_text(state), values)

    def of_health(self, health: Health, *, lost_more: bool) -> Any:
        """Return the status of the daemon's counters: a warning if losses grew, or a recording failed."""
        failure = health.recording.failure
        text = f"{health.frame_rate_hz:.0f} frames/s" + (", losses" if lost_more else "")
        if failure is not None:
            text += ", a recording failed"
        lost = {f"lost_{cause}": count for cause, count in health.lost.model_dump(exclude_none=True).items()}
        keys = ("frames", "frame_rate_hz", "frames_not_decoded", "uptime_s", "clock_drift_ppm", "cpu_percent", "rss_mb")
        values = {key: getattr(health, key) for key in keys} | lost
        return self._status(HEALTH.path, WARN if lost_more or failure is not None else OK, text, values)

    def _status(self, path: str, level: int, text: str, values: Mapping[str, Any]) -> Any:
        make = self._types["diagnostic_msgs/msg/KeyValue"]
        return self._types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=level,
            name=f"{ros_name(self._name)}: {path}",
            message=text,
            hardware_id=self._name,
            values=[make(key=key, value="" if value is None else str(value)) for key, value in values.items()],
        )


def diagnostics_of(store: Typestore, t_ns: int, statuses: list[Any]) -> Any:
    """Return several statuses as one message."""
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9))
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return store.types[DIAGNOSTICS](header=header, status=statuses)
