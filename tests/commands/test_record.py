"""`resonatord record` as a user meets it: a file of what happened, what went wrong in one line, and the exit code."""

import json
import os
import signal
import subprocess
import threading
from contextlib import closing
from pathlib import Path

import pytest
from command_line import PROGRAM, run_command
from emulation import emulated
from recording_bench import read, replayed

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config import load_config
from resonator_daemon.board.config.values import load_plate_text
from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.board.session.link_events import Closed, Received, StateAnnounced, StopRequested
from resonator_daemon.daemon.service.link_recording import NoBoardError, PortInUseError, RecordOptions, record
from simulators.emulator import EmulatorOptions
from simulators.faults import parse_faults


def config(tmp_path: Path, link: str, plate: str = "quartz16") -> Path:
    path = tmp_path / "board.toml"
    path.write_text(f'plate = "{plate}"\nlink = "{link}"\n')
    return path


def test_a_second_of_a_board_is_recorded(tmp_path: Path) -> None:
    port, output = tmp_path / "board", tmp_path / "run.mcap"
    path = config(tmp_path, f"serial:{port}?baud=4000000")
    with emulated(EmulatorOptions("quartz16", pty=port)):
        made = run_command("record", "--config", path, "--output", output, "--seconds", 1, "--json")
    assert made.returncode == 0, made.stderr
    report = json.loads(made.stdout)
    assert (report["verb"], report["ok"], report["board"], report["file"]) == ("record", True, "EMU-0001", str(output))
    assert report["frames"] > 500
    assert report["events_missing"] == sum(report["frames_lost"].values()) == 0
    assert report["file_bytes"] == output.stat().st_size
    assert f"{output}: {report['frames']} frames, 0 lost, " in made.stderr
    with open_recording(str(output), load_plate("quartz16")) as recording:
        events = list(recording.events())
        assert recording.header["link"] == f"serial:{port}?baud=4000000"
        assert load_plate_text(recording.plate_text, output).name == "quartz16"
        assert recording.damage is None
    assert isinstance(events[0], StateAnnounced)
    assert isinstance(events[-1], Closed)
    assert sum(len(event.data) for event in events if isinstance(event, Received)) == report["bytes_received"]


def test_a_board_that_sends_no_frame_is_not_waited_for_without_end(tmp_path: Path) -> None:
    port = tmp_path / "board"
    faults = parse_faults("silence_at_s=0,silence_for_s=60")
    with (
        emulated(EmulatorOptions("quartz16", pty=port, faults=faults)),
        pytest.raises(NoBoardError, match=r"no board sends frames after 0\.8 s: "),
    ):
        record(config(tmp_path, f"serial:{port}?baud=4000000"), RecordOptions(tmp_path / "run.mcap", open_s=0.8))


def test_a_port_in_use_is_reported_at_once(tmp_path: Path) -> None:
    port = tmp_path / "board"
    path = config(tmp_path, f"serial:{port}?baud=4000000")
    options = RecordOptions(tmp_path / "run.mcap", open_s=3600.0)
    with emulated(EmulatorOptions("quartz16", pty=port)):
        with closing(load_config(path).link.open()), pytest.raises(PortInUseError) as raised:
            record(path, options)
        assert (raised.value.exit_code, raised.value.code) == (69, "port_in_use")
        assert f"(pid {os.getpid()})" in str(raised.value)
    assert not options.output.exists()


def test_an_interrupt_ends_a_recording_in_order(tmp_path: Path) -> None:
    port, output = tmp_path / "board", tmp_path / "run.mcap"
    command = [
        *PROGRAM,
        "record",
        "--config",
        str(config(tmp_path, f"serial:{port}?baud=4000000")),
        "--output",
        str(output),
    ]
    with emulated(EmulatorOptions("quartz16", pty=port)):
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        while not output.exists() or output.stat().st_size < 50_000:
            assert process.poll() is None
            threading.Event().wait(0.05)
        process.send_signal(signal.SIGTERM)
        rest = process.stderr.read()
        assert process.wait(60) == 0
        process.stderr.close()
    assert f"{output}: " in rest
    with open_recording(str(output), load_plate("quartz16")) as recording:
        kinds = [type(event) for event in recording.events()]
        assert recording.damage is None
    assert StopRequested in kinds
    assert kinds[-1] is Closed


def test_a_disk_that_fills_ends_a_recording_and_leaves_what_is_written(tmp_path: Path) -> None:
    port, output = tmp_path / "board", tmp_path / "run.mcap"
    path = config(tmp_path, f"serial:{port}?baud=4000000")
    small = ["prlimit", "--fsize=150000", *PROGRAM, "record", "--config", str(path), "--output", str(output), "--json"]
    with emulated(EmulatorOptions("quartz16", pty=port)):
        made = subprocess.run(small, capture_output=True, text=True, timeout=60, check=False)
    assert made.returncode == 1
    assert made.stderr.splitlines()[-1] == (
        f"resonatord: {output}: File too large: nothing more is recorded; what was written stays"
    )
    report = json.loads(made.stdout)
    assert report["error"]["code"] == "ended"
    frames = replayed(output)[1].frames
    assert report["frames"] == frames > 0
    assert f"{output}: {frames} frames, 0 lost, " in made.stderr
    assert read(output)[1] == "cut off"
