"""Processor times of a run, by process."""

import subprocess
import sys

from resonator_daemon.tools.demo.processes import ProcessorTimes

CHILD = "sum(range(4 * 10**7))"  # a second
PARENT = (
    "import subprocess, sys; input(); subprocess.run([sys.executable, '-c', sys.argv[1]]); print(flush=True); input()"
)


def test_a_process_did_not_use_the_time_of_a_child_that_has_ended() -> None:
    command = [sys.executable, "-c", PARENT, CHILD]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        times = ProcessorTimes()
        print(file=parent.stdin, flush=True)
        assert parent.stdout.readline() == "\n"
        times.stop()
        print(file=parent.stdin, flush=True)
    assert {process.pid: used_s for process, used_s in times.used_s.items()}[parent.pid] < 0.3
