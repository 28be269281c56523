"""Windows around marked pixels."""

import numpy as np

from resonator_daemon.elastic.windows import window_around


def test_holds_what_is_hit_and_a_margin_within_the_grid():
    hit = np.zeros((6, 9), bool)
    assert window_around(hit, 2) == (slice(0, 6), slice(0, 9))
    hit[1, 4] = hit[3, 6] = True
    assert window_around(hit) == (slice(1, 4), slice(4, 7))
    assert window_around(hit, 2) == (slice(0, 6), slice(2, 9))
