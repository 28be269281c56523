"""Patches keep their ids while they move, cross a gap and meet others."""

from dataclasses import replace

import numpy as np
import pytest

from resonator_daemon.decoding.patch_tracks import PatchTracker
from resonator_daemon.decoding.patches import Patch


def patch(x_mm: float, y_mm: float = 0.0, radius_mm: float = 2.0) -> Patch:
    return Patch(
        centroid_m=1e-3 * np.array([x_mm, y_mm]),
        centroid_std_m=np.zeros(2),
        area_m2=np.pi * (1e-3 * radius_mm) ** 2,
        force_newton=np.array([0.0, 0.0, 1.0]),
        force_std_newton=np.zeros(3),
        moment_newton_m=np.zeros(3),
        moment_std_newton_m=np.zeros(3),
        at_border=False,
        places=np.arange(2),
    )


def test_ids_follow_two_that_pass_each_other() -> None:
    tracker = PatchTracker()
    for x in np.linspace(-5.0, 5.0, 30):
        found = tracker.update([patch(-x, 1.5), patch(x, -1.5)])
        if x == -5.0:
            ids = {1: 1.5e-3, 2: -1.5e-3}
        assert {i: float(one.centroid_m[1]) for i, one in found.items()} == ids


def test_a_jump_is_another_contact() -> None:
    tracker = PatchTracker()
    tracker.update([patch(0.0, radius_mm=1.5)])
    assert list(tracker.update([patch(1.4, radius_mm=1.5)])) == [1]
    assert list(tracker.update([patch(3.2, radius_mm=1.5)])) == [2]


def test_a_light_touch_may_move_a_millimetre() -> None:
    tracker = PatchTracker()
    tracker.update([patch(0.0, radius_mm=0.2)])
    assert list(tracker.update([patch(0.9, radius_mm=0.2)])) == [1]


def test_new_and_lost_ones() -> None:
    tracker = PatchTracker(patience=1)
    assert list(tracker.update([patch(0.0)])) == [1]
    assert list(tracker.update([patch(0.1), patch(6.0)])) == [1, 2]
    assert list(tracker.update([patch(6.1)])) == [2]
    assert sorted(tracker.update([patch(0.2), patch(6.2)])) == [1, 2]
    tracker.update([patch(6.2)])
    tracker.update([patch(6.2)])
    assert sorted(tracker.update([patch(0.2), patch(6.2)])) == [2, 3]
    assert tracker.update([]) == {}


def test_one_out_of_reach_does_not_push_another_off() -> None:
    tracker = PatchTracker()
    tracker.update([patch(0.0, radius_mm=1.0), patch(1.9, radius_mm=2.0)])
    found = tracker.update([patch(1.8), replace(patch(9.0), at_border=True)])
    assert float(found[2].centroid_m[0]) == pytest.approx(1.8e-3)
    assert sorted(found) == [2, 3]
