"""The load of a computer, by processes whose share of one processor is known."""

import os
import subprocess
import sys

import psutil

from resonator_daemon.demo.host_load import HostLoad


def test_processes_that_share_a_processor_are_overloaded_and_the_first_process_of_the_computer_is_not() -> None:
    spin = f"import os; os.sched_setaffinity(0, [{min(os.sched_getaffinity(0))}])\nwhile True: pass"
    spinning = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(3)]
    load, usage = HostLoad(), psutil.Process(spinning[0].pid)
    while (used_s := usage.cpu_times().user) < 0.2:
        pass
    load.stop()
    for process in spinning:
        process.kill()
        process.wait()
    assert load.overloaded(used_s, {spinning[0].pid})  # each has a third of the processor, and waits for two
    assert not load.overloaded(used_s, {1})
