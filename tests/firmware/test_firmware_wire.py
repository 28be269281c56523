"""The C reference as a whole board, asked by the protocol's own host session."""

import time

import pytest
from firmware_wire_host import WireHost
from listener import DEADLINE_S
from switch import Switch

from firmware_protocol.host import Described, Frame, Located, Pong
from firmware_protocol.layouts import SINGLE_TONE_STRUCT, RecordFlag
from firmware_protocol.messages import BoardStatus, Configuration, Refusal
from resonator_daemon.estimate.tones.frequency_estimators import Sums, frequency_hz
from resonator_daemon.estimate.tones.tone_windows import ToneWindows

pytestmark = pytest.mark.firmware

GATE_TICKS = 1_000_000


def test_frames_are_exact_sums_that_run_on(switch: Switch) -> None:
    with WireHost(switch.link) as host:
        host.start()
        before = host.wait_for(Frame)
        assert before.sequence == 0
        switches = 0
        while not switches or before.sequence < 500:  # a touch comes or goes every 2 s
            frame = host.wait_for(Frame)
            gates = frame.sequence - before.sequence  # more than one where this machine was too slow for QEMU
            assert frame.board_ticks - before.board_ticks == gates * GATE_TICKS
            for earlier, record in zip(before.records, frame.records, strict=True):
                assert record.flags in (0, RecordFlag.STRIDE_BREAK, RecordFlag.STRIDE_BREAK | RecordFlag.CAPTURE_SWITCH)
                switches += bool(record.flags & RecordFlag.CAPTURE_SWITCH)
                sums = Sums.of(record)
                assert 9.971e6 < frequency_hz(sums, 1e9) < 10.0101e6
                if gates == 1 and not record.flags & RecordFlag.STRIDE_BREAK:
                    two_gates = SINGLE_TONE_STRUCT.pack(*earlier) + SINGLE_TONE_STRUCT.pack(*record)
                    assert ToneWindows(1, 2, 1e9, (9e6, 11e6)).push(two_gates).held == [[1], [2]]
            before = frame
    assert host.session.bytes.discarded == 0


def test_a_pong_tells_when_its_ping_came(switch: Switch) -> None:
    """Ticks from answer to answer fit between the shortest and the longest time that can have passed."""
    exchanges = []
    with WireHost(switch.link) as host:
        host.start()
        frame_ticks = host.wait_for(Frame).board_ticks
        for number in range(20):
            opaque = number.to_bytes(8, "little")
            sent_ns = time.monotonic_ns()
            assert host.session.ping(opaque)
            host.send()
            while (pong := host.wait_for(Pong)).opaque != opaque:
                pass  # of a ping that the host sent in a silence
            exchanges.append((sent_ns, pong.board_ticks, time.monotonic_ns()))
            assert pong.board_ticks > frame_ticks  # of a gate that was over before the ping left
            for _ in range(50):
                frame_ticks = host.wait_for(Frame).board_ticks
    first_sent_ns, first_ticks, first_received_ns = exchanges[0]
    for sent_ns, ticks, received_ns in exchanges[1:]:
        assert sent_ns - first_received_ns - 1000 <= ticks - first_ticks <= received_ns - first_sent_ns + 1000


@pytest.mark.parametrize("switch", ["pty"], indirect=True)  # which holds far fewer bytes than sockets do
def test_a_host_that_does_not_read_costs_the_oldest_frames_and_is_told(switch: Switch) -> None:
    with WireHost(switch.link) as host:
        host.start()
        host.wait_until_full()
        frames, told = 0, 0
        while frames < 1000:
            event = host.wait_for(Frame | BoardStatus)
            if isinstance(event, BoardStatus):
                told = event.frames_dropped
            else:
                assert event.sequence == frames + told
                frames += 1
        assert told > 0
    assert host.session.bytes.discarded == 0


def test_the_led_shows_which_board_it_is(switch: Switch) -> None:
    with WireHost(switch.link) as host:
        host.send()
        host.wait_for(Described)
        assert not switch.board.led_is_on()
        host.session.locate()
        host.send()
        assert host.wait_for(Located) == Located(None)
        deadline = time.monotonic() + DEADLINE_S
        while not switch.board.led_is_on():  # it blinks
            assert time.monotonic() < deadline


def test_a_gate_that_the_timer_cannot_make_is_refused(switch: Switch) -> None:
    with WireHost(switch.link) as host:
        host.send()
        host.wait_for(Described)
        host.session.configure(Configuration(GATE_TICKS + 1))
        host.send()
        assert host.wait_for(Refusal).code == 4


def test_the_longest_gate_holds_fifty_times_as_many_stamps(switch: Switch) -> None:
    with WireHost(switch.link) as host:
        host.start(50_000_000)
        first, second = host.wait_for(Frame), host.wait_for(Frame)
    assert second.board_ticks - first.board_ticks == 50_000_000
    assert first.records[0].stamps == pytest.approx(50 * 100, rel=0.005)
