"""What follows from arrivals, in the time that they bring: states, losses, contacts that end, orders."""

import json
from pathlib import Path
from typing import Any

from report_makers import configured
from test_pipeline_messages import FORCE_PLATE as PLATE

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import Arrival, FrameLoss, Gap, LinkChange, Outage
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.measure.pipeline.control_requests import SetWindow, Tare
from resonator_daemon.mqtt.topics import Topic

T0_NS = 1_789_000_000_000_000_000
S = 10**9


class Bench:
    """A pipeline, and what it has published."""

    def __init__(self, tmp_path: Path, plate: str = "quartz16") -> None:
        self.said: list[tuple[str, Any]] = []
        self.pipeline = BoardPipeline(configured(tmp_path, plate), "9f3c", self._publish)

    def handle(self, *arrivals: Arrival) -> None:
        for arrival in arrivals:
            self.pipeline.handle(arrival)

    def last(self, path: str) -> Any:
        return [message for topic, message in self.said if topic == path][-1]

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self.said.append((topic.path, message))


GONE = Reason(ReasonCode.UNPLUGGED, "unplugged")


def change(state: str, at_s: float, reason: str = "", since_s: float | None = None) -> LinkChange:
    since_ns = T0_NS + round(S * (at_s if since_s is None else since_s))
    return LinkChange(state, Reason(ReasonCode.UNPLUGGED, reason), since_ns, T0_NS + round(S * at_s))


def test_a_state_of_the_link_is_dated_when_it_was_reported_and_an_outage_goes_with_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.handle(change("online", 1), Outage(T0_NS, T0_NS + 2 * S, 7, GONE), change("lost", 3, "gone", since_s=2))
    states = [message for topic, message in bench.said if topic == "state/link"]
    assert [(state.state, state.t_ns - T0_NS, state.since_t_ns - T0_NS) for state in states] == [
        ("online", S, S),
        ("online", S, S),
        ("lost", 3 * S, 2 * S),
    ]
    assert states[0].last_outage is None
    assert [state.last_outage.frames_lost for state in states[1:]] == [7, 7]
    sensor = bench.last("state/sensor")
    assert (sensor.state, sensor.reason, sensor.t_ns - T0_NS) == ("waiting", "link lost: gone", 3 * S)


def test_losses_count_from_the_gap_on_that_reports_them(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.handle(change("online", 1))
    assert bench.last("state/link").lost.damaged == 0
    bench.handle(Gap(5, FrameLoss(damaged=2, queue_overflow=1)), Gap(9, FrameLoss(damaged=1)), change("lost", 2))
    lost = bench.last("state/link").lost
    assert (lost.damaged, lost.queue_overflow, lost.link_gap, lost.publish_dropped) == (3, 1, 0, 0)


def test_what_subscribers_missed_is_asked_for_each_message(tmp_path: Path) -> None:
    losses = ((number, 2 * number) for number in range(9))  # dropped, late
    said: list[Any] = []
    bench = BoardPipeline(
        configured(tmp_path, "quartz16"), "9f3c", lambda _, message: said.append(message), lambda: next(losses)
    )
    bench.handle(change("online", 1))
    bench.handle(change("lost", 2))
    assert [message.lost.publish_dropped for message in said] == list(range(len(said)))
    assert [message.lost.skipped_late for message in said] == [2 * number for number in range(len(said))]


def test_an_expired_calibration_is_reported_by_the_day_of_what_arrives(tmp_path: Path) -> None:
    plate = tmp_path / "expired.toml"
    plate.write_text(PLATE + '[calibration]\nid = "c1"\nexpiry = 2026-09-10\n')
    bench = Bench(tmp_path, str(plate))
    day_ns = 86_400 * S
    end_of_expiry_ns = (T0_NS // day_ns + 1) * day_ns  # T0 is on 2026-09-10
    bench.pipeline.pass_time(end_of_expiry_ns - 1)
    bench.handle(change("lost", 0))
    assert "expired" not in str(bench.said)
    bench.pipeline.output.state.update("ok", "", (0.0,) * 4, Instant(T0_NS, 0))
    bench.pipeline.pass_time(end_of_expiry_ns)
    assert (bench.last("state/sensor").state, "c1 expired" in bench.last("state/sensor").reason) == (
        "uncalibrated",
        True,
    )


def test_orders_are_obeyed_in_their_turn_or_refused_with_a_reason(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    order = SetWindow(measurement=Measurement(window_ms=20, step_ms=10)).model_dump_json()
    assert bench.pipeline.apply(order) is None
    assert bench.pipeline.sensor.measurement.step_ms == 10
    assert bench.pipeline.apply(Tare().model_dump_json()) == "no force sites are being measured"
    assert "no request of this version" in bench.pipeline.apply(json.dumps({"verb": "fly"}))
