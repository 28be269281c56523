"""Channelised frames from their parts: complete, incomplete, and parts that do not fit."""

import numpy as np

from firmware_protocol.host import FramePart
from firmware_protocol.layouts import TONE_STRUCT, Block, BlockEncoding, ToneFlag
from resonator_daemon.board.session.frame_receiver import FrameAssembler
from resonator_daemon.board.session.frames import known_tones, variance_of

TONES = 6


def part(sequence: int, channel: int, half: int, flags: int = 0, first: int | None = None) -> FramePart:
    first = 3 * half if first is None else first
    tones = b"".join(
        TONE_STRUCT.pack(7 * tone, 1000 * channel - tone, 0, 100 + tone, flags) for tone in range(first, first + 3)
    )
    block = Block(channel, BlockEncoding.TONE_12, first, 3, 2 * channel + half, 8)
    return FramePart(sequence, 10 * sequence, 72, block, memoryview(tones))


def all_parts(sequence: int) -> list[FramePart]:
    return [part(sequence, channel, half) for channel in range(4) for half in range(2)]


def test_a_complete_frame() -> None:
    assembler = FrameAssembler(TONES)
    frames = [frame for one in all_parts(7) for frame in assembler.add([one])]
    (frame,) = frames
    channel, tone = np.mgrid[:4, :TONES]
    np.testing.assert_array_equal(frame.tones["offset_hz16"], 1000 * channel - tone)
    np.testing.assert_array_equal(frame.tones["phase_turn32"], 7 * tone)
    np.testing.assert_array_equal(frame.tones["sigma_code"], 100 + tone)
    assert known_tones(frame.tones).all()
    np.testing.assert_allclose(variance_of(frame.tones), 2.0 ** ((tone - 28) / 4))
    assert (frame.sequence, frame.board_ticks, frame.parts, len(frame.seen)) == (7, 70, 8, 8)


def test_a_lost_part_leaves_its_tones_unknown_and_keeps_the_frame() -> None:
    assembler = FrameAssembler(TONES)
    parts = all_parts(1)
    del parts[3]  # channel 1, tones 3 to 5
    done = assembler.add(parts)
    assert done == []
    first, *rest = assembler.add(all_parts(2)[:1])
    assert rest == []
    expected = np.ones((4, TONES), bool)
    expected[1, 3:] = False
    np.testing.assert_array_equal(known_tones(first.tones), expected)
    assert (len(first.seen), first.parts) == (7, 8)


def test_flagged_tones_are_unknown_and_parts_beyond_the_plate_are_counted() -> None:
    assembler = FrameAssembler(TONES)
    for flag in ToneFlag:
        assembler.add([part(flag, 0, 0, flags=flag)])
        (frame,) = assembler.flush()
        assert not known_tones(frame.tones).any()
        assert np.isinf(variance_of(frame.tones)).all()
    assembler.add([part(1, 0, 0, first=4)])
    assert assembler.unplaced_parts == 1


def test_a_repeated_part_does_not_complete_a_frame() -> None:
    assembler = FrameAssembler(TONES)
    parts = all_parts(1)
    done = assembler.add([*parts[:6], parts[5], parts[0]])
    assert done == []
    assert assembler.unplaced_parts == 2
    assert [len(frame.seen) for frame in assembler.add(parts[6:])] == [8]
