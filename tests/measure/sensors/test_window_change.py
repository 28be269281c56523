"""Another window and step while a chain runs: what the baseline has learnt, contacts and forces stay."""

from dataclasses import asdict

import numpy as np
import pytest
from single_tone_bench import CLOCK_ERROR, PLATE, UNTOUCHED, Bench, events
from small_comb import GATE_S, SmallComb, spread

PLACE_M = (1.2e-3, -0.9e-3)
LOAD = spread(2.0, *PLACE_M)
WINDOWS = [(10, 20), (20, 5)]


@pytest.mark.parametrize(("before", "after"), WINDOWS)
def test_a_held_touch_of_one_tone_goes_on_with_its_force_and_contact(before, after):
    bench = Bench(window_frames=before, step_frames=5, error=CLOCK_ERROR).untouched()
    loaded_hz = PLATE.loaded_hz(3, 2.5)
    last = bench.hold(loaded_hz, 100)[-1]
    bench.chain.set_window(after, 5)
    readings = bench.hold(loaded_hz, 100)
    assert events(readings) == []
    assert [reading.window_s for reading in readings[-10:]] == pytest.approx([after * 1e-3] * 10)
    assert readings[0].window_s == pytest.approx(min(before + 5, after) * 1e-3)
    assert {contact.id for reading in readings for contact in reading.contacts} == {last.contacts[0].id}
    for reading in readings:
        assert reading.status == "ok"
        (force,) = reading.sites
        noise_newton = force.noise_newton + last.sites[0].noise_newton
        assert abs(force.force_newton - last.sites[0].force_newton) < 6 * noise_newton < 0.03
    assert readings[0].compensation.common_mode == last.compensation.common_mode


def test_a_baseline_learns_as_well_from_another_window_as_from_the_first():
    changed, steady = Bench(window_frames=20, step_frames=5), Bench(window_frames=5, step_frames=5)
    changed.chain.set_window(5, 5)
    for bench in (changed, steady):
        bench.untouched()
    np.testing.assert_equal(*(asdict(bench.readings[-1].compensation) for bench in (changed, steady)))  # NaN as NaN


@pytest.mark.parametrize(("before", "after"), [(2, 4), (4, 1)])
def test_a_held_touch_under_a_cover_goes_on_with_its_force_and_contact(before, after):
    comb = SmallComb(window_frames=before, step_frames=1).untouched()
    last = comb.hold(LOAD, 40)[-1]
    comb.chain.set_window(after, 1)
    readings = comb.hold(LOAD, 20)
    assert all(reading.events == () for reading in readings)
    assert readings[0].window_s == pytest.approx(min(before + 1, after) * GATE_S)
    assert readings[-1].window_s == pytest.approx(after * GATE_S)
    for reading in readings:
        assert reading.status == "ok"
        (contact,), (first,) = reading.contacts, last.contacts
        assert contact.id == first.id
        noise_newton = contact.touch.noise_newton + first.touch.noise_newton
        assert abs(contact.touch.force_newton - first.touch.force_newton) < 6 * noise_newton < 0.03
    assert readings[0].compensation.baseline == "followed"


@pytest.mark.parametrize(("window_frames", "step_frames"), [(4, 5), (4, 0), (0, 0)])
def test_a_step_beyond_the_window_is_refused_and_changes_nothing(window_frames, step_frames):
    bench, comb = Bench().untouched(), SmallComb(window_frames=2, step_frames=1).untouched()
    for chain in (bench.chain, comb.chain):
        with pytest.raises(ValueError, match=f"step of {step_frames} frames, 1 to the window's {window_frames}"):
            chain.set_window(window_frames, step_frames)
    assert [reading.window_s for reading in bench.hold(UNTOUCHED, 10)] == pytest.approx([0.01, 0.01])
    assert [reading.window_s for reading in comb.hold(frames=3)] == pytest.approx([2 * GATE_S] * 3)
