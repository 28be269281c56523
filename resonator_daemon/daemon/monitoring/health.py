"""How the daemon itself fares: rates, losses, processor, memory, and what it holds of the system."""

import asyncio
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

from resonator_daemon.base.host.load import HostLoad, ProcessUsage
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
        use = self._process.measure()
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
            cpu_percent=use.cpu_percent,
            processor_wait_percent=load.processor_wait_percent,
            rss_mb=use.rss_mb,
            tasks=len(asyncio.all_tasks()),
            threads=use.threads,
            file_descriptors=use.file_descriptors,
            latency=latency,
            decoder=decoder,
            recording=recording,
            commands=commands,
            messages=messages,
        )


def _not_decoded(skipped: Mapping[str, int]) -> int:
    return sum(count for cause, count in skipped.items() if cause != _NOT_READY)
