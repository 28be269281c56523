"""The load of a computer, by processes whose share of one processor is known."""

import os
import subprocess
import sys

import psutil

from resonator_daemon.demo.host_load import HostLoad


def test_processes_that_share_a_processor_are_overloaded_and_a_waiting_one_is_not() -> None:
    waiting = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    assert waiting.stdin is not None
    assert waiting.stdout is not None
    waiting.stdin.write(b"started")
    assert waiting.stdout.read(7) == b"started"
    spin = f"import os; os.sched_setaffinity(0, [{min(os.sched_getaffinity(0))}])\nwhile True: pass"
    spinning = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(3)]
    load, usage = HostLoad(), psutil.Process(spinning[0].pid)
    while (used_s := usage.cpu_times().user) < 0.3:
        pass
    load.stop()
    for process in (waiting, *spinning):
        process.kill()
        process.wait()
    assert load.overloaded(used_s, {spinning[0].pid})  # each has a third of the processor, and waits for two
    assert not load.overloaded(used_s, {waiting.pid})
