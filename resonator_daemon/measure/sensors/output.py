"""Way out of a sensor: headers, lateness and latency of its messages, and its state."""

from collections.abc import Callable
from typing import Any, Final

from resonator_daemon.board.config import Config
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces.readings import ForceReading, SkinReading
from resonator_daemon.measure.latency import Latencies
from resonator_daemon.measure.sensors.sensor_state import SensorState
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import HeaderFields, Headers, Topic

Publish = Callable[[Topic[Any], Any], None]

_NS: Final = 1_000_000_000


class MessageOutput:
    """Publishes the messages of one sensor.

    Parameters
    ----------
    config
    headers
        Makes the headers.
    state
        State of the sensor, which follows its readings.
    publish
        Called with topic and message.
    is_late
        Returns whether a message about a window that ends at this instant is too late to be published.

    Attributes
    ----------
    latencies
        Histograms of the messages with results.
    skipped_late
        Number of messages that were skipped because they were late.
    """

    def __init__(
        self,
        config: Config,
        headers: Headers,
        state: SensorState,
        publish: Publish,
        is_late: Callable[[Instant], bool],
    ) -> None:
        self.headers = headers
        self.state = state
        self.is_late = is_late
        self.publish = publish
        self.skipped_late = 0
        self.latencies = Latencies(1 / config.plate.counter.frame_rate_hz)
        self._gate_s = 1 / config.plate.counter.frame_rate_hz
        self._is_live = config.link.recording_path is None  # a recording has the clock of its time

    def publish_result(self, topic: Topic[Any], message: Message | Encoded, gate_middle: Instant) -> None:
        """Publish a message with a result; record its latency."""
        if self._is_live:
            self.latencies.count(topic, gate_middle)
        self.publish(topic, message)

    def skip(self, *topics: Topic[Any]) -> None:
        """Skip a message of each topic because it would be late."""
        self.headers.skip(*topics)
        self.skipped_late += len(topics)

    def window(self, reading: ForceReading | SkinReading, gate_middle: Instant) -> HeaderFields:
        """Return the header of all messages about a reading whose last gate has this middle, without `seq`."""
        t_ns = gate_middle.utc_ns - round((reading.window_s - self._gate_s) * _NS / 2)
        return self.headers.of_window(t_ns, gate_middle.uncertainty_ns, reading.board_ticks)
