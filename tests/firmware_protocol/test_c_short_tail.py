"""Bursts on a USB bulk endpoint end with a short packet, whatever buffer is below and whenever packets leave."""

import subprocess

from c_reference import driver


def test_a_burst_ends_with_a_short_packet_and_keeps_its_order() -> None:
    done = subprocess.run([driver("short_tail")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "1")
