"""Faults of the whole emulator in real time, read by the host's end of the protocol."""

import os
import select
import socket
from collections import Counter
from itertools import pairwise
from pathlib import Path

from emulation import balanced_report, emulated
from wire_host import Host, opened, wait_for

from firmware_protocol.host import Described
from firmware_protocol.messages import ResetCause
from simulators.emulator import OTHER_SERIAL_NUMBER, SERIAL_NUMBER, EmulatorOptions
from simulators.faults import FaultPlan, parse_faults


def quartz(path: Path, faults: str, **options: object) -> EmulatorOptions:
    return EmulatorOptions("quartz16", pty=path, scenario="still", faults=parse_faults(faults), **options)


def sequences(host: Host) -> list[int]:
    return [frame.sequence for frame in host.frames]


def described(host: Host) -> list[Described]:
    return [event for event in host.events if isinstance(event, Described)]


def test_all_that_happens_to_bytes_at_once_is_what_the_report_says(tmp_path: Path) -> None:
    path = tmp_path / "board"
    faults = (
        "bit_error_rate=2e-5,burst_rate_hz=10,garbage_rate_hz=20,duplicate_rate=0.05,lost_chunk_rate_hz=5,"
        "reorder_rate=0.02,split_bytes=50,clump_ms=16,delay_ms=3,frame_delay_rate=0.02,frame_delay_ms=8,"
        "answer_delay_rate=0.5,answer_delay_ms=20"
    )
    with emulated(quartz(path, faults, seed=3)) as emulator, opened(path) as host:
        host.read_until(lambda: len(host.frames) >= 600)
    counts = balanced_report(emulator)["faults"]
    received = sequences(host)
    # Before, the answer to START may be late; beyond, frames may come later still.
    judged = range(60, max(received) - 40)
    hit, twice = Counter(counts["frame_sequences_hit"]), Counter(counts["frame_sequences_duplicated"])
    expected = Counter(judged) - hit + twice
    assert all(Counter(received)[number] == expected[number] for number in judged)
    passed = {second for first, second in pairwise(received) if second < first}
    assert passed
    assert passed <= set(counts["frame_sequences_delayed"])
    for count in ("bursts", "garbage_bursts", "packets_duplicated", "chunks_lost", "chunks_reordered", "bits_flipped"):
        assert counts[count] > 0, count


def test_a_brown_out_cuts_a_frame_and_the_board_says_why_it_began_anew(tmp_path: Path) -> None:
    path = tmp_path / "board"
    with emulated(quartz(path, "brown_out_at_s=0.1")) as emulator, opened(path) as host:
        host.read_until(lambda: len(described(host)) == 2)
        before = len(host.frames)
        host.read_until(lambda: len(host.frames) >= before + 20)
    first, second = described(host)
    assert (first.identity.reset_cause, second.identity.reset_cause) == (ResetCause.POWER_ON, ResetCause.BROWN_OUT)
    assert first.boot_id != second.boot_id
    counts = balanced_report(emulator)["faults"]
    assert counts["brown_outs"] == 1
    assert counts["frame_sequences_cut"] == [before]
    assert sequences(host)[: before + 20] == [*range(before), *range(20)]
    assert host.session.bytes.discarded == 102


def test_another_board_is_there_for_a_while_and_the_own_one_returns_newly_booted(tmp_path: Path) -> None:
    path = tmp_path / "board"
    boards = []
    with emulated(quartz(path, "wrong_board_at_s=0.05,wrong_board_for_s=0.3")) as emulator:
        for frames in (10, 1, 10):
            wait_for(path.exists)
            with opened(path) as host:
                host.read_until(lambda host=host, frames=frames: len(host.frames) >= frames)
                boards.append(described(host)[0])
                if len(boards) < 3:
                    host.read_until(lambda: False)
                    assert host.gone
    assert [board.identity.serial_number for board in boards] == [SERIAL_NUMBER, OTHER_SERIAL_NUMBER, SERIAL_NUMBER]
    assert len({board.boot_id for board in boards}) == 3
    assert balanced_report(emulator)["faults"]["wrong_boards"] == 1


def test_a_port_takes_another_name_and_is_gone_from_the_old_one(tmp_path: Path) -> None:
    old, new = tmp_path / "board", tmp_path / "board.1"
    with emulated(quartz(old, "rename_at_s=0.05,rename_to=board.1")) as emulator:
        with opened(old) as host:
            host.read_until(lambda: False)
            assert host.gone
        wait_for(new.exists)
        assert not old.is_symlink()
        assert str(new) in emulator.link.address
        with opened(new) as host:
            host.read_until(lambda: len(host.frames) >= 10)
    assert balanced_report(emulator)["faults"]["renames"] == 1
    assert os.listdir(tmp_path) == []


def test_the_scenario_s_faults_hold_beside_those_of_the_command_line(tmp_path: Path) -> None:
    path, scenario = tmp_path / "board", tmp_path / "mine.toml"
    scenario.write_text(
        "[faults]\nduplicate_rate = 1.0\nbit_error_rate = 1.0\n[[faults.events]]\nat_s = 0.1\nwhat = 'reboot'\n"
    )
    faults = FaultPlan(bit_error_rate=0.0)
    options = EmulatorOptions("quartz16", pty=path, scenario=str(scenario), faults=faults)
    with emulated(options) as emulator, opened(path) as host:
        host.read_until(lambda: len(described(host)) >= 2)
    counts = balanced_report(emulator)["faults"]
    assert counts["reboots"] == 1
    assert counts["bits_flipped"] == 0
    assert sequences(host)[:4] == [0, 0, 1, 1]


def test_a_terminal_does_not_show_that_its_host_has_gone(tmp_path: Path) -> None:
    path, truth = tmp_path / "board", tmp_path / "truth.jsonl"
    with emulated(quartz(path, "", speed=20.0, truth=truth)) as emulator:
        with opened(path) as host:
            host.read_until(lambda: len(host.frames) >= 10)
        wait_for(lambda: truth.read_bytes().count(b"\n") >= 3000)  # more than the queue holds
    dropped = balanced_report(emulator)["dropped_by_cause"]
    assert (dropped["queue_full"] > 1000, dropped["discarded"]) == (True, 0)


def test_a_new_tcp_host_gets_nothing_before_it_asks() -> None:
    with emulated(EmulatorOptions("quartz16", tcp=("127.0.0.1", 0), scenario="still")) as emulator:
        host, _, port = emulator.link.address.removeprefix("tcp://").partition(":")
        address = (host, int(port))
        with socket.create_connection(address) as connection:
            first = Host(connection.fileno(), 1_000_000)
            first.read_until(lambda: len(first.frames) > 50)  # the board counts, and will not stop
        with socket.create_connection(address) as connection:
            readable, _, _ = select.select([connection], [], [], 0.3)
            assert not readable
            second = Host(connection.fileno(), 1_000_000)
            second.read_until(lambda: len(second.frames) > 50)
    assert second.frames[0].sequence == 0
