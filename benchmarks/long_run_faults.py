"""What a long run does to the daemon, drawn from a seed: boards one after the other, each with faults of its own."""

import random
from typing import Final, NamedTuple

from long_run_log import Cause

_LEG_S: Final = (20.0, 90.0)
_TICKS: Final = 250_000_000


class BoardLeg(NamedTuple):
    """One life of the emulator: how long, what goes wrong, and whether it is killed at its end."""

    seconds: float
    faults: str
    causes: frozenset[Cause]
    killed: bool


def draw_leg(draw: random.Random) -> BoardLeg:
    """Draw a leg with none to three faults, which come at random or, those that happen once, within the leg."""
    seconds = draw.uniform(*_LEG_S)
    faults, causes = [], set()
    for what in draw.sample(sorted(_FAULTS), draw.choice((0, 1, 1, 2, 3))):
        text, cause = _FAULTS[what]
        at_s = draw.uniform(3.0, max(3.1, seconds - 8.0))
        rate = 10 ** draw.uniform(-1.0, 0.0)
        faults.append(text.format(at=round(at_s, 2), rate=round(rate, 3), short=round(draw.uniform(0.3, 4.0), 2)))
        causes.add(cause)
    return BoardLeg(seconds, ",".join(faults), frozenset(causes), killed=draw.random() < 0.15)


# `rate` is between 0.1 and 1 a second, `at` within the leg, `short` up to 4 s.
_FAULTS: Final[dict[str, tuple[str, Cause]]] = {
    "bit errors": ("bit_error_rate={rate}e-5", Cause.DAMAGE),
    "bursts": ("burst_rate_hz={rate}", Cause.DAMAGE),
    "garbage": ("garbage_rate_hz={rate}", Cause.DAMAGE),
    "lost bytes": ("lost_chunk_rate_hz={rate},lost_chunk_bytes=900", Cause.DAMAGE),
    "duplicates": ("duplicate_rate=1e-3", Cause.DAMAGE),
    "clumps": ("clump_ms=16", Cause.DELAY),
    "late answers": ("answer_delay_rate=0.5,answer_delay_ms=100", Cause.DELAY),
    "late frames": ("frame_delay_rate=0.01", Cause.DELAY),
    "slow reader": ("slow_reader_bytes_per_s=180000", Cause.OVERFLOW),
    "bad contact": ("unplug_rate_hz=0.05,unplug_for_s={short}", Cause.GONE),
    "unplugged": ("unplug_at_s={at},unplug_for_s={short}", Cause.GONE),
    "frozen": ("freeze_at_s={at},freeze_for_s={short}", Cause.FREEZE),
    "silent": ("silence_at_s={at},silence_for_s={short}", Cause.SILENCE),
    "rebooted": ("reboot_at_s={at}", Cause.REBOOT),
    "brown-out": ("brown_out_at_s={at}", Cause.BROWN_OUT),
    "ticks jump": (f"tick_step_at_s={{at}},tick_step_ticks={_TICKS}", Cause.TICKS),
    "another board": ("wrong_board_at_s={at},wrong_board_for_s={short}", Cause.OTHER_BOARD),
}
