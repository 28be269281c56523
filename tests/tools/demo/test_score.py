"""The score of the demo on hand-made truth and messages, by the definitions of the `demo --json` contract."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from score_run import MS, Run, frame_end_ns, touch

from resonator_daemon.tools.demo.score import Accuracy


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Windows of two frames."""
    run = Run(tmp_path / "truth.jsonl")
    yield run
    run.close()


# Latency: from the end of the last gate in the window, by the emulator's clock, to the subscriber.


def test_latency_counts_from_the_end_of_the_last_gate(run: Run) -> None:
    for _ in range(6):
        run.truth()
    run.forces(3, arrived_ns=frame_end_ns(3) + 2_100_000)
    run.forces(5, arrived_ns=frame_end_ns(5) + 7_900_000)
    run.decoded(4, np.zeros((3, 2, 2)), arrived_ns=frame_end_ns(4) + 4_250_000)
    assert run.result().latency_ms == pytest.approx([2.1, 7.9, 4.25])


def test_a_message_waits_for_its_truth_and_counts_once(run: Run) -> None:
    run.forces(1, (7, 1.003), arrived_ns=frame_end_ns(1) + 3 * MS)
    run.score.join()  # no truth file yet
    run.truth(touch(1.0))
    whole = run.line(1, touch(1.0))
    run.write(whole[:-20])
    run.score.join()  # a line that is not whole yet
    assert run.score.latency_ms == []
    run.write(whole[-20:])
    for _ in range(3):
        run.score.join()
    assert run.score.latency_ms == pytest.approx([3.0])
    assert run.result().force_error_newton_rms == pytest.approx(0.003)


# A contact is found when an onset at its site arrives whose time is within 50 ms of the moment when the true force
# crosses 20 mN. It is late as well where the onset arrives more than 50 ms after that moment.


@pytest.mark.parametrize(
    ("after_ns", "found"),
    [(0, 1), (12 * MS, 1), (50 * MS, 1), (50 * MS + 1, 0), (-50 * MS, 1), (-50 * MS - 1, 0), (-(10**9), 0)],
)
def test_an_onset_within_50_ms_of_the_crossing_finds_a_touch(run: Run, after_ns: int, found: int) -> None:
    run.ramp(0.005, 0.012, 0.0199, 0.0201, 0.5, 1.0)
    run.onset(frame_end_ns(3) + after_ns, arrived_ns=frame_end_ns(3) + 20 * MS)
    assert run.found() == (1, found, 0)


@pytest.mark.parametrize(("after_ns", "late"), [(13 * MS, 0), (50 * MS, 0), (50 * MS + 1, 1), (7 * 10**9, 1)])
def test_an_onset_that_arrives_after_more_than_50_ms_is_late(run: Run, after_ns: int, late: int) -> None:
    run.ramp(0.0, 1.0)
    run.onset(frame_end_ns(1) + 10 * MS, arrived_ns=frame_end_ns(1) + after_ns)
    assert run.found() == (1, 1, late)
    assert run.result().late_ms == pytest.approx([after_ns / MS] * late)


def test_a_touch_of_20_mn_counts_and_less_does_not(run: Run) -> None:
    run.ramp(0.005, 0.019999, 0.005, id=1)
    run.ramp(0.005, 0.020, 0.005, id=2)
    assert run.found() == (1, 0, 0)


def test_presses_by_hand_are_counted_and_what_is_touched_meanwhile_is_not_scored(run: Run) -> None:
    by_hand = touch(2.0, id=1_000_001, site=9)
    run.ramp(0.5, id=1)
    run.forces(1, (7, 0.4))
    run.truth(touch(0.5), by_hand)
    run.forces(2, (7, 9.0))
    run.ramp(*[0.0] * 201)
    run.ramp(0.5, 0.5, id=2)
    run.onset(frame_end_ns(203))
    run.forces(204, (7, 0.503))
    assert run.found() == (1, 1, 0)
    assert run.score.by_hand == {1_000_001}
    assert run.result().force_error_newton_rms == pytest.approx(0.003)


def test_each_touch_needs_an_onset_of_its_own_time(run: Run) -> None:
    for number in range(3):
        run.ramp(0.0, 1.0, id=number + 1, site=number + 5)
        for _ in range(198):
            run.truth()
    run.onset(frame_end_ns(1) + 10 * MS, site=5)
    run.onset(frame_end_ns(401) + 60 * MS, site=7)  # of another time than the third touch
    assert run.found() == (3, 1, 0)


# Force error: against the truth averaged over the same window, contacts above 5 % of their peak.


def test_force_errors_are_pooled_over_windows_against_their_mean_truth(run: Run) -> None:
    run.ramp(1.0, 2.0, 2.0, 3.0)  # means of the windows of two: 1.5, 2.0, 2.5
    run.forces(1, (7, 1.503))
    run.forces(2, (7, 1.996))
    run.forces(3, (7, 2.512))
    assert run.result().force_error_newton_rms == pytest.approx(math.sqrt((9 + 16 + 144) / 3) * 1e-3)


def test_only_forces_above_5_percent_of_their_own_touchs_peak_count(run: Run) -> None:
    run.ramp(0.09, 0.09, 2.0, 2.0, id=1)  # the peak comes after the weak window
    run.ramp(0.03, 0.03, id=2, site=8)  # a weak touch is measured by its own peak
    run.forces(1, (7, 0.5))  # 0.09 is 4.5 % of the peak: an error of 0.41 that does not count
    run.forces(3, (7, 2.003))
    run.forces(5, (8, 0.034))
    assert run.result().force_error_newton_rms == pytest.approx(math.sqrt((9 + 16) / 2) * 1e-3)


# What came before the first `health` after `begin` belongs to the set-up.


def test_errors_and_latency_count_from_the_beginning(run: Run) -> None:
    run.ramp(1.0, 1.0, 1.0, 1.0)
    run.forces(1, (7, 1.5), arrived_ns=frame_end_ns(1) + 90 * MS)
    run.decoded(1, np.zeros((3, 2, 2)), arrived_ns=frame_end_ns(1) + 90 * MS)
    run.begin(at_ns=frame_end_ns(2))
    assert run.result(frame_end_ns(3)) == Accuracy()
    run.forces(3, (7, 1.003), arrived_ns=frame_end_ns(3) + 3 * MS)
    result = run.result()
    assert result.latency_ms == pytest.approx([3.0])
    assert result.force_error_newton_rms == pytest.approx(0.003)
    assert (run.score.decoded_frames, result.traction_error) == (0, None)


def test_what_was_skipped_between_the_last_health_and_the_beginning_belongs_to_the_set_up(run: Run) -> None:
    run.health(100, not_decoded=4)
    run.score.begin()
    assert not run.score.begun
    run.decoded(1, np.zeros((3, 2, 2)), seq=57)  # 57 more were skipped
    run.health(190, not_decoded=61, parts=2)
    assert run.score.begun
    run.decoded(1, np.zeros((3, 2, 2)), seq=64)
    run.health(290, not_decoded=67, parts=3)
    losses = run.score.losses
    assert (losses["not_decoded"], losses["parts"], run.score.messages_missed) == (6, 1, 6)
    assert (run.score.frames, run.score.decoded_frames) == (100, 1)


def test_gaps_between_messages_are_counted_by_topic(run: Run) -> None:
    for seq in (3, 4, 7):
        run.forces(1, seq=seq)
    run.begin()
    run.decoded(1, np.zeros((3, 2, 2)), seq=1)
    run.forces(1, seq=9)
    assert run.score.messages_missed == 1
