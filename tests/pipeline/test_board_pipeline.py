"""What follows from arrivals, in the time that they bring: states, losses, contacts that end, orders."""

import json
from pathlib import Path
from typing import Any

import pytest
from report_makers import configured
from test_reports import FORCE_PLATE as PLATE

from resonator_daemon.config import Measurement
from resonator_daemon.pipeline.board_pipeline import BoardCourse
from resonator_daemon.pipeline.control_requests import MeasureOver, Tare
from resonator_daemon.publishing.topics import Topic
from resonator_daemon.session.counters import FrameLoss
from resonator_daemon.session.frames import Arrival, BoardLogLine, ControlRequest, Gap, LinkChange, Outage

T0_NS = 1_789_000_000_000_000_000
S = 10**9


class Course:
    """A course, and what it has published."""

    def __init__(self, tmp_path: Path, plate: str = "quartz16") -> None:
        self.said: list[tuple[str, Any]] = []
        self.course = BoardCourse(configured(tmp_path, plate), "9f3c", self._publish)

    def take(self, *arrivals: Arrival) -> None:
        for arrival in arrivals:
            self.course.take(arrival)

    def last(self, path: str) -> Any:
        return [message for topic, message in self.said if topic == path][-1]

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self.said.append((topic.path, message))


def change(state: str, at_s: float, reason: str = "", since_s: float | None = None) -> LinkChange:
    since_ns = T0_NS + round(S * (at_s if since_s is None else since_s))
    return LinkChange(state, reason, since_ns, T0_NS + round(S * at_s))


def test_a_state_of_the_link_is_dated_when_it_was_said_and_an_outage_goes_with_it(tmp_path: Path) -> None:
    course = Course(tmp_path)
    course.take(change("online", 1), Outage(T0_NS, T0_NS + 2 * S, 7, "unplugged"), change("lost", 3, "gone", since_s=2))
    states = [message for topic, message in course.said if topic == "state/link"]
    assert [(state.state, state.t_ns - T0_NS, state.since_t_ns - T0_NS) for state in states] == [
        ("online", S, S),
        ("online", S, S),
        ("lost", 3 * S, 2 * S),
    ]
    assert states[0].last_outage is None
    assert [state.last_outage.frames_lost for state in states[1:]] == [7, 7]
    sensor = course.last("state/sensor")
    assert (sensor.state, sensor.reason, sensor.t_ns - T0_NS) == ("waiting", "link lost: gone", 3 * S)


def test_losses_count_from_the_gap_on_that_told_of_them(tmp_path: Path) -> None:
    course = Course(tmp_path)
    course.take(change("online", 1))
    assert course.last("state/link").lost.damaged == 0
    course.take(Gap(5, FrameLoss(damaged=2, ring_overflow=1)), Gap(9, FrameLoss(damaged=1)), change("lost", 2))
    lost = course.last("state/link").lost
    assert (lost.damaged, lost.ring_overflow, lost.link_gap, lost.publish_dropped) == (3, 1, 0, 0)


def test_what_subscribers_missed_is_asked_for_each_message(tmp_path: Path) -> None:
    dropped = iter(range(9))
    said: list[Any] = []
    course = BoardCourse(
        configured(tmp_path, "quartz16"), "9f3c", lambda _, message: said.append(message), lambda: next(dropped)
    )
    course.take(change("online", 1))
    course.take(change("lost", 2))
    assert [message.lost.publish_dropped for message in said] == list(range(len(said)))


def test_contacts_end_by_the_time_that_passes_in_what_arrives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    course = Course(tmp_path)
    ended: list[str] = []
    monkeypatch.setattr(course.course.measuring, "_tell_of_last_forces", lambda events: ended.append("told"))
    monkeypatch.setattr(type(course.course.measuring), "force_chain", EndingChain(ended))
    course.take(change("online", 1), change("lost", 2))
    course.course.pass_time(T0_NS + 2 * S + S // 2 - 1)
    assert ended == []
    course.course.pass_time(T0_NS + 2 * S + S // 2)
    assert ended == ["no frames for 0.5 s", "told"]


class EndingChain:
    def __init__(self, ended: list[str]) -> None:
        self._ended = ended

    def end_contacts(self, reason: str) -> tuple[()]:
        self._ended.append(reason)
        return ()


def test_an_expired_calibration_is_told_by_the_day_of_what_arrives(tmp_path: Path) -> None:
    plate = tmp_path / "expired.toml"
    plate.write_text(PLATE + '[calibration]\nid = "c1"\nexpiry = 2026-09-10\n')
    course = Course(tmp_path, str(plate))
    day_ns = 86_400 * S
    end_of_expiry_ns = (T0_NS // day_ns + 1) * day_ns  # T0 is on 2026-09-10
    course.course.pass_time(end_of_expiry_ns - 1)
    course.take(change("lost", 0))
    assert "expired" not in str(course.said)
    course.course.measuring._sensor.update("ok", "", (0.0,) * 4, T0_NS)
    course.course.pass_time(end_of_expiry_ns)
    assert (course.last("state/sensor").state, "c1 expired" in course.last("state/sensor").reason) == (
        "uncalibrated",
        True,
    )


def test_orders_are_obeyed_in_their_turn_or_refused_with_a_reason(tmp_path: Path) -> None:
    course = Course(tmp_path)
    order = MeasureOver(measurement=Measurement(window_ms=20, step_ms=10)).model_dump_json()
    assert course.course.apply_control(order) == ""
    assert course.course.reporter.measurement.step_ms == 10
    assert course.course.apply_control(Tare().model_dump_json()) == "no force sites are being measured"
    assert "no order of this version" in course.course.apply_control(json.dumps({"verb": "fly"}))


def test_a_refused_order_of_a_recording_and_words_of_the_board_go_to_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    course = Course(tmp_path)
    course.take(ControlRequest("key", Tare().model_dump_json()), BoardLogLine(90, "hot"))
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("WARNING", "no force sites are being measured"),
        ("ERROR", "board: hot"),
    ]
