"""A daemon that is watched tells what memory it uses, and goes on as it was."""

import os
import subprocess
import sys
from pathlib import Path

import watched_daemon
from watched_daemon import FILE_VARIABLE, ask_in_use, in_use


def test_what_is_taken_from_malloc_and_from_python_is_in_use_and_what_is_given_back_is_not() -> None:
    before = in_use()
    large = [bytes(100_000) for _ in range(50)] + [bytes(4 << 20)]  # the last of them in a mapping of its own
    small = [object() for _ in range(20_000)]
    held = in_use()
    assert 8.0 < held.malloc_mb - before.malloc_mb < 12.0
    assert 19_000 < held.python_blocks - before.python_blocks < 22_000
    del large, small
    after = in_use()
    assert abs(after.malloc_mb - before.malloc_mb) < 1.0
    assert abs(after.python_blocks - before.python_blocks) < 1000


def test_a_process_is_asked_again_and_again_and_who_is_gone_says_nothing(tmp_path: Path) -> None:
    told = tmp_path / "in_use.json"
    text = (
        "import signal, sys, watched_daemon as w; signal.signal(signal.SIGUSR1, w._tell); print(flush=True);"
        "sys.stdin.read(); print('in order')"
    )
    environment = os.environ | {
        "PYTHONPATH": str(Path(watched_daemon.__file__).parent),
        FILE_VARIABLE: str(told),
    }
    with subprocess.Popen(
        [sys.executable, "-c", text], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        for _ in range(3):
            told.write_text('{"malloc_mb": 0.0, "python_blocks": 0}')  # of another time
            used = ask_in_use(process.pid, told, 30.0)
            assert used is not None
            assert used.malloc_mb > 0.1
            assert used.python_blocks > 1000
        assert process.communicate()[0] == "in order\n"
    assert ask_in_use(process.pid, told, 30.0) is None


def test_it_is_resonatord(tmp_path: Path) -> None:
    command = [sys.executable, watched_daemon.__file__, "run", "--config", str(tmp_path / "none.toml")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 78
    assert "none.toml" in done.stderr
