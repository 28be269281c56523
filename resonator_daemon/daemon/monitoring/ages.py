"""Seconds since moments that are given in UTC, by the monotonic clock: the wall clock may be set in between."""

import time
from typing import Final

from resonator_daemon.daemon.monitoring.status import Status

_DELAY_MAX_S: Final = 10.0  # at most, if the wall clock was not set meanwhile


class Ages:
    """Counts the seconds since moments from when it first sees them; to be asked about once a second.

    The wall clock is used only for the time before that, and only if it is short.
    """

    def __init__(self) -> None:
        self._started_s = time.monotonic()
        self._begun: dict[str, tuple[int, float]] = {}

    def of(self, status: Status) -> dict[str, float]:
        """Return `ages_s` of a status."""
        now_s, utc_ns = time.monotonic(), time.time_ns()
        uptime_s = now_s - self._started_s
        ages = {"started": uptime_s}
        for name, moment_ns in _moments(status).items():
            if moment_ns is None:
                continue
            if moment_ns == status.started_t_ns:
                ages[name] = uptime_s
                continue
            known_ns, begun_s = self._begun.get(name, (None, now_s))
            if known_ns != moment_ns:
                passed_s = (utc_ns - moment_ns) * 1e-9
                begun_s = now_s - min(passed_s, uptime_s) if 0 <= passed_s <= _DELAY_MAX_S else now_s
                self._begun[name] = moment_ns, begun_s
            ages[name] = now_s - begun_s
        return ages


def _moments(status: Status) -> dict[str, int | None]:
    daemon, link, sensor = status.daemon, status.link, status.sensor
    outage = link.last_outage if link else None
    return {
        "config": status.config.loaded_t_ns,
        "daemon": daemon.since_t_ns if daemon else None,
        "link": link.since_t_ns if link else None,
        "sensor": sensor.since_t_ns if sensor else None,
        "outage": outage.end_t_ns if outage else None,
        "connected": daemon.connected_t_ns if daemon else None,
        "recording": status.recording.since_t_ns,
    }
