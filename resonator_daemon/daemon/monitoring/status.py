"""Status of a running daemon, one snapshot for socket, metrics and `health`: states, counters, configuration."""

import asyncio
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final, Literal

from pydantic import Field

from resonator_daemon.base.host.load import HostLoad, ProcessUsage
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.session.frames import LinkCounters
from resonator_daemon.mqtt.payloads import BootInfo, DecoderProcessInfo, Health, Int64, Message, RecordingInfo, State

_DELAY_MAX_S: Final = 10.0  # from a moment until it is seen, if the wall clock was not set meanwhile
_NOT_READY: Final = "not_ready"  # frames that came while the decoder was being set up: nothing is lost by them


class ConfigChange(Message):
    """Key whose value in the file, when it was last read again, was another one than in use."""

    key: str = Field(description="as mqtt.url")
    old: str = Field(description="that was in use")
    new: str = Field(description="that the file has")
    applied: bool = Field(description="whether it is in use; else after a restart")


class ConfigStatus(Message):
    """Configuration that a daemon uses."""

    file: str = Field(description="that the daemon was started with, absolute")
    in_use: Literal["file", "last_good"] = Field(
        description="`file`: its content when it was last read without problems; `last_good`: a copy kept from an "
        "earlier run, because the file had problems at the start"
    )
    reason_code: ReasonCode | None = Field(
        None, description="why the file is not in use as it is: `bad_configuration`, `restart_needed`; null if it is"
    )
    problems: tuple[str, ...] = Field(
        (),
        description="of the file as it was last read, as `resonatord check` prints them; not empty: it is not in use",
    )
    loaded_t_ns: Int64 = Field(description="UTC, when what is in use was read")
    needs_restart: tuple[str, ...] = Field(
        (), description="keys that the file has changed and that have an effect after a restart only"
    )
    reloads: int = Field(0, description="how often the file was read again")
    changes: tuple[ConfigChange, ...] = Field((), description="by the last time that it was, where it could be used")


class BrokerStatus(Message):
    """Connection of a daemon to its broker."""

    url: str = Field(description="without user and password")
    connected: bool = Field(description="whether messages go out at present")


class Status(Message):
    """Status of one daemon."""

    name: str | None = Field(
        description="under which it publishes; null until the board has reported its serial number"
    )
    instance: str = Field(description="file name of the configuration, without its ending")
    pid: int = Field(description="of the daemon's process")
    version: str = Field(description="of resonatord")
    started_t_ns: Int64 = Field(description="UTC")
    config: ConfigStatus = Field(description="which configuration is in use")
    daemon: State | None = Field(description="as last published on `state/daemon`")
    link: State | None = Field(description="as last published on `state/link`")
    sensor: State | None = Field(description="as last published on `state/sensor`")
    health: Health | None = Field(description="as last made for `health`; null in the first second")
    broker: BrokerStatus = Field(description="how it stands with its broker")
    recording: RecordingInfo = Field(description="as in `health`")
    ages_s: dict[str, float] = Field(
        {},
        description="since the daemon `started`; since `config` in use was read, `daemon`, `link` and `sensor` are in "
        "their states, the last `outage` ended, the broker is `connected`, the `recording` began, each where there is "
        "such a moment; by the monotonic clock",
    )


class StatusMonitor:
    """Makes `health` and the ages in a status of this process; called by tasks of the event loop, once a second.

    Rates are over the time since the last `health`. Ages count by the monotonic clock since the monitor first saw the
    moment. The wall clock, which may be set, is used only for the time before that, and only if it is short.
    """

    def __init__(self) -> None:
        self._process = ProcessUsage()
        self._started_s = self._last_s = time.monotonic()
        self._last_frames = 0
        self._begun: dict[str, tuple[int, float]] = {}  # moment in UTC and by the monotonic clock, by name

    def health(
        self,
        header: Mapping[str, Any],
        link: LinkCounters,
        load: HostLoad,
        decoder: DecoderProcessInfo | None = None,
        **other: Any,
    ) -> Health:
        """Return a message with this header, and with `other` fields as they are."""
        now_s = time.monotonic()
        rate_hz = (link.frames - self._last_frames) / max(now_s - self._last_s, 1e-3)
        self._last_s, self._last_frames = now_s, link.frames
        skipped = decoder.skipped if decoder is not None else {}
        return Health(
            **header,
            reason_code=load.busy.code if load.busy else None,
            uptime_s=now_s - self._started_s,
            frames=link.frames,
            frame_rate_hz=rate_hz,
            parts_lost=link.parts_lost,
            frames_not_decoded=sum(count for cause, count in skipped.items() if cause != _NOT_READY),
            packets_ignored={
                "stale": link.messages_stale,
                "malformed": link.messages_malformed,
                "unknown": link.messages_unknown,
                "log": link.log_lines_dropped,
            },
            bytes_in=link.bytes_received,
            bytes_by_outcome={
                outcome: getattr(link, f"bytes_{outcome}")
                for outcome in ("accepted", "other_version", "echo", "discarded", "waiting")
            },
            connections=link.connections,
            host_overruns=link.host_overruns,
            boots=tuple(
                BootInfo(
                    board_boot_id=f"{boot.boot_id:08x}",
                    connections=boot.connections,
                    frames=boot.frames,
                    lost=asdict(boot.lost),
                    lost_in_outages=asdict(boot.lost_in_outages),
                )
                for boot in link.boots
            ),
            clock_outliers=link.clock_outliers,
            clock_restarts=link.clock_restarts,
            **self._process.measure()._asdict(),
            processor_wait_percent=load.processor_wait_percent,
            tasks=len(asyncio.all_tasks()),
            decoder=decoder,
            **other,
        )

    def with_ages(self, status: Status) -> Status:
        """Return a status with its `ages_s`."""
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
        return status.model_copy(update={"ages_s": ages})


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
