"""What a board describes against the shipped plates: what fits, and a sentence for each thing that does not."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_protocol.messages import Description
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.session.compatibility import incompatibilities, oscillator_hz

QUARTZ, SKIN = load_plate("quartz16"), load_plate("skin32")

QUARTZ_BOARD = Description(
    counter_kind=0,
    channels=4,
    tones=1,
    reference_millihertz=10**12,  # 1 GHz
    gate_ticks_min=100_000,  # 0.1 ms
    gate_ticks_max=100_000_000,  # 0.1 s
    plate="quartz16",
)
SKIN_BOARD = Description(
    counter_kind=1,
    channels=4,
    tones=3072,
    reference_millihertz=250 * 10**9,
    gate_ticks_min=1_000_000,  # 4 ms
    gate_ticks_max=25_000_000,  # 100 ms
    plate="skin32",
    oscillator_millihertz=10**11,  # 100 MHz, in steps of 3250 Hz: the plate's own tones
    oscillator_spacing_millihertz=3_250_000,
)


def test_oscillators_lie_on_a_comb() -> None:
    comb = replace(SKIN_BOARD, tones=3, oscillator_millihertz=99_000_000_500, oscillator_spacing_millihertz=1_001)
    np.testing.assert_array_equal(oscillator_hz(comb), [99_000_000.5, 99_000_001.501, 99_000_002.502])


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"plate": "quartz9"}, "wrong_plate", ("plate", "quartz9, ", 'set plate = "quartz9"')),
        ({"counter_kind": 1}, "wrong_counter", ("counter kind", "channelised", "single-tone")),
        ({"channels": 3}, "wrong_counter", ("channels", "describes 3", "has 4")),
        ({"reference_millihertz": 999 * 10**9}, "wrong_reference", ("reference_hz", "999000000", "1000000000")),
        ({"gate_ticks_min": 10, "gate_ticks_max": 9}, "wrong_gate", ("gate", "at least 10 and at most 9")),
        ({"gate_ticks_min": 0, "gate_ticks_max": 0}, "wrong_gate", ("frame rate",)),
        ({"gate_ticks_max": 2**32}, "wrong_gate", ("gate", "up to 4294967296 ticks")),
        ({"gate_ticks_step": 300_000}, "wrong_gate", ("frame rate", "300000", "1000000")),
    ],
)
def test_incompatibilities_have_both_values(change: dict[str, object], code: str, words: tuple[str, ...]) -> None:
    ((found, sentence),) = incompatibilities(replace(QUARTZ_BOARD, **change), QUARTZ)  # type: ignore[arg-type]
    assert found == code
    assert all(word in sentence for word in words)


def test_tones_must_agree_only_where_they_are_numbered() -> None:
    ((_, sentence),) = incompatibilities(replace(SKIN_BOARD, tones=3071), SKIN)
    assert all(word in sentence for word in ("tones", "3071", "3072"))
    assert incompatibilities(replace(QUARTZ_BOARD, tones=16), QUARTZ) == ()


@pytest.mark.parametrize(
    ("reference_ppm", "gates", "fits"),
    [
        (0.9, (1_000_000, 100_000_000), True),
        (-0.9, (100_000, 1_000_000), True),
        (1.1, (100_000, 100_000_000), False),
        (-1.1, (100_000, 100_000_000), False),
        (0.0, (1_000_001, 100_000_000), False),
        (0.0, (100_000, 999_999), False),
    ],
)
def test_clocks_may_differ_by_their_rounding_and_the_frame_rate_is_one_that_the_board_makes(
    reference_ppm: float, gates: tuple[int, int], fits: bool
) -> None:
    reference = round(10**12 * (1 + reference_ppm * 1e-6))
    board = replace(QUARTZ_BOARD, reference_millihertz=reference, gate_ticks_min=gates[0], gate_ticks_max=gates[1])
    assert (incompatibilities(board, QUARTZ) == ()) == fits


@pytest.mark.parametrize("sign", [1, -1])
def test_oscillators_must_be_within_reach_of_the_tones(sign: int) -> None:
    just_within = replace(SKIN_BOARD, oscillator_millihertz=10**11 + sign * 32_767_000)
    assert incompatibilities(just_within, SKIN) == ()
    beyond = replace(SKIN_BOARD, oscillator_millihertz=10**11 + sign * 32_768_000)
    ((_, sentence),) = incompatibilities(beyond, SKIN)
    assert all(word in sentence for word in ("32768 Hz", "32767 Hz"))
