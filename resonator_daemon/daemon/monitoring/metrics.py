"""Status of a daemon as metrics for Prometheus; docs/how-to/monitor.md lists them."""

import math
import time
from collections.abc import Iterator, Mapping
from itertools import accumulate
from typing import Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.mqtt.payloads import Condition, Health, LatencyInfo, State

_WAITING: Final = "waiting"  # of bytes_by_outcome: goes up and down


class StatusCollector(Collector):
    """Makes metrics of what was last put into `status`; each has the label `daemon`, its instance.

    Names have base units and `_total` where they only ever grow, by Prometheus' conventions. What is not known is left
    out.
    """

    def __init__(self) -> None:
        self.status: Status | None = None

    def collect(self) -> Iterator[Metric]:
        if self.status is not None:
            yield from _Families(self.status).all()


class _Families:
    """The metrics of one status."""

    def __init__(self, status: Status) -> None:
        self._status = status

    def all(self) -> Iterator[Metric]:
        yield from self._of_the_daemon()
        yield from self._of_the_recording()
        yield from self._of_the_states()
        if self._status.health is not None:
            yield from self._of_the_link(self._status.health)
            yield from self._of_the_messages(self._status.health)
            yield from self._of_the_process(self._status.health)

    def _of_the_daemon(self) -> Iterator[Metric]:
        status, config = self._status, self._status.config
        labels = {"name": status.name or "", "version": status.version}
        yield self._gauge("resonatord_info", "1; the name it publishes under, and its version", 1, **labels)
        last_good = config.in_use == "last_good"
        yield self._gauge("resonatord_config_last_good", "1 while it works by an earlier run's copy", last_good)
        yield self._gauge("resonatord_config_problems", "Why the present file is not in use", len(config.problems))
        needs_restart = len(config.needs_restart)
        yield self._gauge("resonatord_config_needs_restart", "Changed keys that wait for a restart", needs_restart)
        loaded_s = config.loaded_t_ns * 1e-9
        yield self._gauge("resonatord_config_load_time_seconds", "When the configuration in use was read", loaded_s)
        yield self._gauge("resonatord_broker_connected", "1 while connected to the broker", status.broker.connected)

    def _of_the_recording(self) -> Iterator[Metric]:
        recording = self._status.recording
        runs, failed = recording.file is not None, recording.failure is not None
        missing = {"events": recording.events_missing, "messages": recording.messages_missing}
        yield self._gauge("resonatord_recording", "1 while a recording is being written", runs and not failed)
        yield self._gauge("resonatord_recording_failed", "1 while a recording takes nothing more", failed)
        yield self._gauge("resonatord_recording_file_bytes", "Of the present file", recording.file_bytes)
        yield self._counter("resonatord_recording_files", "Files that were begun", recording.files)
        yield self._counter(
            "resonatord_recording_files_removed", "Old recordings gone for the budget", recording.files_removed
        )
        yield self._counters("resonatord_recording_missing", "What was recorded and is in no file", "what", missing)

    def _of_the_states(self) -> Iterator[Metric]:
        link = self._status.link
        up = link is not None and link.state is Condition.ONLINE
        yield self._gauge("resonatord_link_up", "1 while the board's frames come", up)
        word = GaugeMetricFamily(
            "resonatord_state", "1 for the present one of a part", labels=["daemon", "part", "state"]
        )
        since = GaugeMetricFamily(
            "resonatord_state_start_time_seconds", "Since when a part is as it is", labels=["daemon", "part"]
        )
        for part, state in self._states().items():
            for condition in Condition:
                word.add_metric([self._status.instance, part, condition.value], state.state is condition)
            if state.since_t_ns is not None:
                since.add_metric([self._status.instance, part], state.since_t_ns * 1e-9)
        yield word
        yield since
        if link is not None and link.boot_count is not None:
            yield self._counter("resonatord_board_boots", "Different boots of the board seen", link.boot_count)

    def _states(self) -> dict[str, State]:
        states = {"daemon": self._status.daemon, "link": self._status.link, "sensor": self._status.sensor}
        return {part: state for part, state in states.items() if state is not None}

    def _of_the_link(self, health: Health) -> Iterator[Metric]:
        lost = health.lost.model_dump(exclude={"publish_dropped", "skipped_late"})  # those are messages
        fates = {fate: count for fate, count in health.bytes_by_outcome.items() if fate != _WAITING}
        bytes_waiting = health.bytes_by_outcome.get(_WAITING, 0)
        yield self._counter("resonatord_frames", "Frames that arrived", health.frames)
        yield self._counters("resonatord_frames_lost", "Frames lost", "cause", lost)
        yield self._counter("resonatord_messages_late", "Messages not published, being late", health.lost.skipped_late)
        yield self._counter("resonatord_frame_parts_lost", "Parts of frames lost", health.parts_lost)
        yield self._counter("resonatord_frames_not_decoded", "Frames the decoder skipped", health.frames_not_decoded)
        if (decoder := health.decoder) is not None:
            yield self._counters(
                "resonatord_decoder_frames_skipped", "Frames the decoder skipped", "cause", decoder.skipped
            )
            yield self._counters(
                "resonatord_decoder_restarts", "Restarts of the decoder process", "cause", decoder.restarts
            )
            yield self._gauge("resonatord_decoder_cpu_ratio", "Processor time, of one core", decoder.cpu_percent * 0.01)
            yield self._gauge("resonatord_decoder_resident_memory_bytes", "Memory", decoder.rss_mb * 1e6)
        yield self._counters(
            "resonatord_records_unusable", "Readings that gave no frequency", "cause", health.records_unusable
        )
        yield self._counters(
            "resonatord_packets_ignored", "Packets that led to nothing", "cause", health.packets_ignored
        )
        yield self._counters("resonatord_link_bytes", "Bytes from the board by what became of them", "fate", fates)
        yield self._gauge("resonatord_link_waiting_bytes", "Bytes of an incomplete packet", bytes_waiting)
        yield self._counter("resonatord_link_connections", "Openings of the link", health.connections)
        yield self._counter("resonatord_host_overruns", "Times the port's driver lost bytes", health.host_overruns)
        if math.isfinite(health.clock_drift_ppm):
            drift = health.clock_drift_ppm * 1e-6
            yield self._gauge("resonatord_clock_drift_ratio", "Rate of the board's clock against this one's", drift)
        yield self._counter("resonatord_clock_outliers", "Pings that contradicted the others", health.clock_outliers)
        yield self._counter("resonatord_clock_restarts", "Times the clock was estimated again", health.clock_restarts)

    def _of_the_messages(self, health: Health) -> Iterator[Metric]:
        account = health.messages
        fates = account.model_dump(include={"acknowledged", "written", "unknown_at_disconnect"})
        repeated = account.model_dump(include={"republished", "resent", "recovered"})
        waits = {"memory": account.waiting - account.spooled, "disk": account.spooled}
        yield self._counter("resonatord_messages_enqueued", "Messages to publish", account.enqueued)
        yield self._counters("resonatord_messages_sent", "Messages by what became of them", "fate", fates)
        yield self._counters("resonatord_messages_repeated", "Of those: once more", "why", repeated)
        yield self._counters("resonatord_messages_dropped", "Messages never sent", "cause", account.dropped)
        waiting = GaugeMetricFamily("resonatord_messages_waiting", "Messages not yet sent", labels=["daemon", "where"])
        for where, count in waits.items():
            waiting.add_metric([self._status.instance, where], count)
        yield waiting
        yield self._counters("resonatord_commands", "Commands by what became of them", "outcome", health.commands)
        latency = HistogramMetricFamily(
            "resonatord_latency_seconds",
            "From the end of a window's last gate to the publisher",
            labels=["daemon", "topic"],
        )
        for topic, histogram in health.latency.items():
            # The daemon does not add durations up, and a histogram without a sum may be published.
            latency.add_metric([self._status.instance, topic], _buckets(histogram), sum_value=None)
        yield latency

    def _of_the_process(self, health: Health) -> Iterator[Metric]:
        """Name these as all clients of Prometheus do; read without /proc, which the service's sandbox may hide."""
        started_s, memory_bytes = self._status.started_t_ns * 1e-9, health.rss_mb * 1e6
        yield self._gauge("process_start_time_seconds", "Start of the daemon", started_s)
        yield self._counter("process_cpu_seconds", "Processor time, user and system", time.process_time())
        yield self._gauge("process_resident_memory_bytes", "Resident memory", memory_bytes)
        yield self._gauge("process_open_fds", "File descriptors held open", health.file_descriptors)
        yield self._gauge("resonatord_threads", "Threads of the daemon", health.threads)
        yield self._gauge("resonatord_tasks", "Tasks of the daemon's event loop", health.tasks)

    def _gauge(self, name: str, meaning: str, value: float, /, **labels: str) -> Metric:
        family = GaugeMetricFamily(name, meaning, labels=["daemon", *labels])
        family.add_metric([self._status.instance, *labels.values()], float(value))
        return family

    def _counter(self, name: str, meaning: str, count: float) -> Metric:
        family = CounterMetricFamily(name, meaning, labels=["daemon"])
        family.add_metric([self._status.instance], count)
        return family

    def _counters(self, name: str, meaning: str, label: str, counts: Mapping[str, int]) -> Metric:
        family = CounterMetricFamily(name, meaning, labels=["daemon", label])
        for value, count in counts.items():
            family.add_metric([self._status.instance, value], count)
        return family


def _buckets(histogram: LatencyInfo) -> list[tuple[str, float]]:
    """Return upper bounds in s, and how many messages took no longer."""
    bounds = [str(bound_ms / 1e3) for bound_ms in histogram.bounds_ms]
    return list(zip([*bounds, "+Inf"], accumulate(histogram.counts), strict=True))
