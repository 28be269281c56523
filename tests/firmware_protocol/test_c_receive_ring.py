"""The ring between a receiving interrupt and the main loop, with an interrupt at each place where order matters."""

import subprocess

from c_reference import driver


def test_no_byte_is_lost_or_read_before_it_is_there_and_a_full_ring_refuses_one() -> None:
    done = subprocess.run([driver("receive_ring")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["1", "1"])
