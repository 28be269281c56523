"""The whole emulator in real time, read by the host's end of the protocol."""

import os
import socket
import threading
import time
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from emulation import balanced_report, emulated
from wire_host import Host, opened, truths, wait_for

from firmware_protocol.host import FramePart
from firmware_protocol.messages import BoardStatus
from resonator_daemon.base.plate import load_plate
from simulators.emulator import EmulatorOptions
from simulators.physics import Physics
from simulators.truth import TruthOutput
from simulators.world import with_world


def test_quartz16_sends_its_frames_in_time_and_writes_the_truth_beside_them(tmp_path: Path) -> None:
    path, truth_path = tmp_path / "board", tmp_path / "truth.jsonl"
    fds = len(os.listdir("/proc/self/fd"))
    options = EmulatorOptions("quartz16", pty=path, scenario="held", truth=truth_path)
    with emulated(options) as emulator, opened(path) as host:
        begin_ns = time.time_ns()
        host.read_until(lambda: len(host.frames) >= 300)
        end_ns = time.time_ns()
        wait_for(lambda: len(truths(truth_path)) >= 300)
    frames, truth, report = host.frames, truths(truth_path), balanced_report(emulator)
    assert [frame.sequence for frame in frames] == list(range(len(frames)))
    assert [line["sequence"] for line in truth] == list(range(report["frames_made"]))
    assert [line["board_ticks"] for line in truth[: len(frames)]] == [frame.board_ticks for frame in frames]
    stamps = [int(line["t_ns"]) for line in truth[:300]]
    assert begin_ns < stamps[0]
    assert stamps[299] <= end_ns
    assert stamps[299] - stamps[0] == pytest.approx(299e6, abs=2e6)  # but for the slewing of the system's clock
    assert all(isinstance(line["t_ns"], str) for line in truth)
    (contact,) = truth[0]["contacts"]
    assert contact == {
        "id": 1, "site": 7, "position_m": [-0.0005, 0.002], "force_newton": [0.0, 0.0, 1.0], "radius_m": None
    }  # fmt: skip
    assert truth[0]["plate_kelvin"] == 298.15
    causes = ("drop_rate", "queue_full", "silence", "too_late", "discarded")
    assert report["dropped_by_cause"] == dict.fromkeys(causes, 0)
    assert report["truth_lines_lost"] == 0
    assert report["bytes_sent"] >= host.session.bytes.received >= 300 * 204
    assert not path.is_symlink()
    assert len(os.listdir("/proc/self/fd")) == fds


def test_frames_of_a_busy_computer_are_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real_ns, ahead_ns = time.monotonic_ns, [0]
    monkeypatch.setattr(time, "monotonic_ns", lambda: real_ns() + ahead_ns[0])
    options = EmulatorOptions("quartz16", pty=tmp_path / "board", scenario="held")
    with emulated(options) as emulator, opened(tmp_path / "board") as host:
        host.read_until(lambda: len(host.frames) >= 10)
        ahead_ns[0] = 60_000_000_000
        host.read_until(lambda: host.frames[-1].sequence > 60_000)
        missing = host.frames[-1].sequence + 1 - len(host.frames)
    assert emulator.report()["dropped_by_cause"]["too_late"] == missing
    assert next(event.frames_dropped for event in host.events if isinstance(event, BoardStatus)) == missing


@pytest.mark.parametrize(("plate", "tones", "parts_a_frame"), [("skin32", 3072, 20), ("fingertip400", 1200, 8)])
def test_a_skin_sends_all_its_tones_on_four_channels_over_tcp(
    tmp_path: Path, plate: str, tones: int, parts_a_frame: int
) -> None:
    truth_path = tmp_path / "truth.jsonl"
    options = EmulatorOptions(plate, tcp=("127.0.0.1", 0), truth=truth_path)
    with emulated(options) as emulator:
        host_name, port = emulator.link.address.removeprefix("tcp://").rsplit(":", 1)
        with socket.create_connection((host_name, int(port))) as client:
            host = Host(client.fileno(), 2_500_000)
            parts: list[FramePart] = []

            def enough() -> bool:
                parts[:] = [event for event in host.events if isinstance(event, FramePart)]
                return len(parts) >= 80 * parts_a_frame

            host.read_until(enough)
    assert [part.sequence for part in parts[: 80 * parts_a_frame]] == list(np.repeat(np.arange(80), parts_a_frame))
    assert sum(part.block.tones for part in parts[:parts_a_frame]) == 4 * tones
    contacts = truths(truth_path)[79]["contacts"]  # 0.795 s: 0.295 s into the rise of 0.4 s
    assert set(contacts[0]) == {
        "id", "site", "position_m", "force_newton", "radius_m", "stick_radius_m", "friction_coefficient"
    }  # fmt: skip
    assert contacts[0]["radius_m"] == pytest.approx(2.5e-3 * contacts[0]["force_newton"][2] ** (1 / 3))
    assert emulator.report()["bytes_sent"] >= 80 * parts_a_frame * 36


@pytest.mark.parametrize(("given", "seeds_alike"), [(None, True), (7, True), (8, False)])
def test_the_scenario_fixes_the_seed_unless_another_is_given(
    tmp_path: Path, given: int | None, seeds_alike: bool
) -> None:
    scenario = tmp_path / "mine.toml"
    scenario.write_text("seed = 7\n[plate]\ndrop_rate = 0.2\n")
    lost = []
    for seed in (given, 7):
        options = EmulatorOptions("quartz16", pty=tmp_path / "board", scenario=str(scenario), seed=seed)
        with emulated(options) as emulator, opened(tmp_path / "board") as host:
            host.read_until(lambda host=host: bool(host.frames) and host.frames[-1].sequence >= 200)
        lost.append(set(range(200)) - {frame.sequence for frame in host.frames})
        assert balanced_report(emulator)["dropped_by_cause"]["drop_rate"] >= len(lost[-1]) > 20
    assert (lost[0] == lost[1]) == seeds_alike


LINE = "x" * 199 + "\n"


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "truth"
    os.mkfifo(path)
    return path


def test_a_pipe_waits_for_no_reader_and_serves_one_that_comes(pipe: Path) -> None:
    output = TruthOutput(pipe)
    output.write(LINE)
    output.write(LINE)
    assert output.lines_lost == 2
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    output.write("three\n")
    assert os.read(reader, 100) == b"three\n"
    os.close(reader)
    output.write("four\n")
    output.write("five\n")
    assert output.lines_lost == 4
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    output.write("six\n")
    output.close()
    assert os.read(reader, 100) == b"six\n"
    assert os.read(reader, 100) == b""
    os.close(reader)
    assert output.lines_lost == 4


def test_a_reader_that_pauses_gets_all_lines_and_one_that_sleeps_only_whole_ones(pipe: Path) -> None:
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    output = TruthOutput(pipe)
    for _ in range(2000):  # several times what a pipe takes
        output.write(LINE)
    assert output.lines_lost == 0
    for _ in range(40_000):
        output.write(LINE)
    lost = output.lines_lost
    assert 10_000 < lost < 40_000
    received: list[bytes] = []
    os.set_blocking(reader, True)

    def read() -> None:
        while data := os.read(reader, 65536):
            received.append(data)

    reading = threading.Thread(target=read)
    reading.start()
    output.write("again\n")
    while len(output._waiting):
        output._flush()
    output.close()
    reading.join()
    os.close(reader)
    lines = b"".join(received).decode().splitlines(keepends=True)
    assert lines[:-1] == [LINE] * (len(lines) - 1)
    assert len(lines) + output.lines_lost == 42_001


def test_a_world_changes_the_plate_and_not_its_name() -> None:
    skin = with_world(load_plate("skin32"), "depth=1.05,modulus=0.95,poisson=0.45,gain=1.05").plate
    until = load_plate("comb16").calibration.model_copy(update={"expiry": date(2030, 1, 1), "date": date(2026, 1, 1)})
    comb = with_world(load_plate("comb16").model_copy(update={"calibration": until}), "k=2,oscillator=3")
    assert (skin.required_skin.depth_mm, skin.tones.sensitivity[0, 0]) == pytest.approx((1.05, -2.1e-11))
    assert comb.plate.tones.sensitivity == pytest.approx(2.0 * load_plate("comb16").tones.sensitivity)
    assert comb.with_oscillator_noise(Physics()).white_fm == pytest.approx(9e-10)
    for plate, spec, key in (
        ("quartz16", "f0=2e-6,depth=1.05", "depth"),
        ("skin32", "dead=p_n@1025", "dead"),
        ("skin32", "common_walk=x", "common_walk"),
        ("skin32", "dept=1.05", "dept"),
        ("skin32", "layer=1", "layer"),
        ("skin32", "adhesion=1.1", "adhesion"),
        ("skin32", "adhesion=0.1,shape=punch", "adhesion"),
        ("skin32", "shape=cone", "shape"),
        ("skin32", "positions_mm=1.29", "positions_mm"),
        ("fingertip400", "positions_mm=1.41", "positions_mm"),
    ):
        with pytest.raises(ValueError, match=rf"^world\.{key}: "):
            with_world(load_plate(plate), spec)
    assert with_world(load_plate("skin32"), "positions_mm=1.28").positions_mm == 1.28  # of 12.8 mm


def test_command_line_overrides_the_world_of_a_scenario(tmp_path: Path) -> None:
    skin = with_world(load_plate("skin32"), "depth=1.1", {"depth": 1.05, "modulus": 0.9}).plate.required_skin
    assert (skin.depth_mm, skin.youngs_modulus_pascal) == pytest.approx((1.1, 1.8e5))
    scenario = tmp_path / "mine.toml"
    scenario.write_text("[world]\nlayer = 1.2\n")
    options = EmulatorOptions("skin32", tcp=("127.0.0.1", 0), scenario=str(scenario), world="depth=1.3")
    with pytest.raises(ValueError, match=r"^world\.layer: "), emulated(options):
        pass
    with emulated(replace(options, world="depth=1.3,layer=1.4")) as emulator:
        assert emulator.plate_name == "skin32"
