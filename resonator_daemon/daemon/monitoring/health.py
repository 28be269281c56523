"""How the daemon itself fares: rates, losses, processor, memory, and what it holds of the system."""

import asyncio
import math
import resource
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final, NamedTuple

import psutil

from resonator_daemon.base.host.load import HostLoad
from resonator_daemon.board.session.counters import LinkCounters
from resonator_daemon.mqtt.payloads import (
    BootInfo,
    DecoderProcessInfo,
    Health,
    LatencyInfo,
    MessageAccount,
    RecordingInfo,
)

_NOT_READY: Final = "not_ready"  # frames that came while the decoder was being set up: nothing is lost by them


class Held(NamedTuple):
    """What a process uses; `cpu_percent` is of one core, since the last call of `held`."""

    cpu_percent: float
    rss_mb: float
    threads: int
    file_descriptors: int


class ProcessUsage:
    """Processor time, memory and threads of a process; by default of this one."""

    def __init__(self, pid: int | None = None) -> None:
        self._process = psutil.Process(pid)
        self._last = self._now()  # and begin the interval of the processor time

    @property
    def pid(self) -> int:
        return self._process.pid

    def held(self) -> Held:
        """Return what it uses now.

        The system reports it in files. If none can be opened, or the process has ended, `cpu_percent` is NaN,
        `file_descriptors` the limit, and the rest as it was.
        """
        try:
            self._last = self._now()
        except (OSError, psutil.Error):
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            return self._last._replace(cpu_percent=math.nan, file_descriptors=most)
        return self._last

    def _now(self) -> Held:
        rss_mb = float(self._process.memory_info().rss) * 1e-6
        return Held(self._process.cpu_percent(), rss_mb, self._process.num_threads(), self._process.num_fds())


class HealthMonitor:
    """Makes the `health` messages of this process; rates are over the time since the last message."""

    def __init__(self) -> None:
        self._process = ProcessUsage()
        self._started = self._last = time.monotonic()
        self._last_frames = 0

    def report(
        self,
        header: Mapping[str, Any],
        link: LinkCounters,
        messages: MessageAccount,
        clock_drift_ppm: float,
        load: HostLoad,
        records_unusable: dict[str, int],
        latency: dict[str, LatencyInfo],
        recording: RecordingInfo,
        commands: dict[str, int],
        decoder: DecoderProcessInfo | None = None,
    ) -> Health:
        """Return a message with this header; to be called by a task of the event loop, whose tasks are counted."""
        now = time.monotonic()
        rate_hz = (link.frames - self._last_frames) / max(now - self._last, 1e-3)
        self._last, self._last_frames = now, link.frames
        held = self._process.held()
        return Health(
            **header,
            reason_code=load.busy.code if load.busy else None,
            uptime_s=now - self._started,
            frames=link.frames,
            frame_rate_hz=rate_hz,
            parts_lost=link.parts_lost,
            frames_not_decoded=_not_decoded(decoder.skipped) if decoder is not None else 0,
            records_unusable=records_unusable,
            packets_ignored={
                "stale": link.messages_stale,
                "malformed": link.messages_malformed,
                "unknown": link.messages_unknown,
                "log": link.log_lines_dropped,
            },
            bytes_in=link.bytes_received,
            bytes_by_outcome={
                "accepted": link.bytes_accepted,
                "other_version": link.bytes_other_version,
                "echo": link.bytes_echo,
                "discarded": link.bytes_discarded,
                "waiting": link.bytes_waiting,
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
            clock_drift_ppm=clock_drift_ppm,
            clock_outliers=link.clock_outliers,
            clock_restarts=link.clock_restarts,
            cpu_percent=held.cpu_percent,
            lacking_percent=load.lacking_percent,
            rss_mb=held.rss_mb,
            tasks=len(asyncio.all_tasks()),
            threads=held.threads,
            file_descriptors=held.file_descriptors,
            latency=latency,
            decoder=decoder,
            recording=recording,
            commands=commands,
            messages=messages,
        )


def _not_decoded(skipped: Mapping[str, int]) -> int:
    return sum(count for cause, count in skipped.items() if cause != _NOT_READY)
