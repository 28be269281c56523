"""Bytes between interrupts, the main loop and a USB endpoint: none lost, none out of order.

`receive_ring` has an interrupt at each place where order matters; `short_tail` ends bursts with a short packet,
whatever buffer is below and whenever packets leave.
"""

import subprocess

import pytest
from c_reference import driver


@pytest.mark.parametrize(("name", "printed"), [("receive_ring", ["1", "1"]), ("short_tail", ["1"])])
def test_no_byte_is_lost_or_out_of_order(name: str, printed: list[str]) -> None:
    done = subprocess.run([driver(name)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, printed)
