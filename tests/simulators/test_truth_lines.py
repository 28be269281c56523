"""The truth beside the bytes: its lines, and how they get out of a file or a pipe whose reader comes and goes."""

import os
import threading
from pathlib import Path

import pytest

from simulators.truth import TruthOutput

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
