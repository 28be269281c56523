"""A whole board over USB: the daemon's reader in a process that sees the emulated bus."""

from collections.abc import Iterator

import pytest
from emulation import emulated
from usb_bench import UsbHost

from simulators.emulator import Emulator, EmulatorOptions
from simulators.faults import parse_faults

_READER = """
import threading
from resonator_daemon.session.board_reader import BoardReader
from resonator_daemon.session.frames import ChannelisedFrame, Gap, LinkChange, SingleToneFrame
from resonator_daemon.links.table import parse_link
from resonator_daemon.plate import load_plate

woken = threading.Event()
frames, missing, out_of_place, states = 0, 0, [], []

def take():
    global frames, missing
    for arrival in reader.pop_arrivals():
        if isinstance(arrival, SingleToneFrame | ChannelisedFrame):
            if arrival.index != frames + missing:
                out_of_place.append((arrival.index, frames, missing))
            frames += 1
        elif isinstance(arrival, Gap):
            missing += arrival.loss.total
        elif isinstance(arrival, LinkChange):
            states.append((arrival.state, arrival.reason.code))

def read_until(condition):
    while not condition():
        if not woken.wait(20.0):
            raise TimeoutError(f"{frames} frames, states {states}")
        woken.clear()
        take()

def start(link, plate):
    global reader
    reader = BoardReader(parse_link(link), load_plate(plate), woken.set)
    reader.start()

def stop():
    global account
    reader.stop()
    take()
    account = reader.counters()

def in_bins(account):
    return (account.bytes_accepted + account.bytes_other_version + account.bytes_echo
            + account.bytes_discarded + account.bytes_waiting)
"""


@pytest.fixture
def host(emulator: Emulator) -> Iterator[UsbHost]:
    host = UsbHost(emulator.environment)
    try:
        host.run(_READER)
        yield host
        host.close()
    finally:
        host.kill()


@pytest.fixture
def emulator(request: pytest.FixtureRequest) -> Iterator[Emulator]:
    plate, faults = request.param
    with emulated(EmulatorOptions(plate, usb=True, faults=parse_faults(faults))) as emulator:
        yield emulator


@pytest.mark.parametrize("emulator", [("quartz16", ""), ("skin32", "")], indirect=True)
def test_frames_arrive_and_the_link_loses_none(emulator: Emulator, host: UsbHost) -> None:
    host.run(f"start({emulator.link.address!r}, {emulator.plate_name!r})")
    host.run("read_until(lambda: frames >= 100); stop()")
    assert host.value("out_of_place") == []
    # A computer that halts lets the buffers of board and reader run over: they say so, and nothing else may lose any.
    given_up = host.value("account.lost.board_overflow + account.lost.queue_overflow")
    assert host.value("missing") == host.value("account.lost.total") == given_up
    assert host.value("account.bytes_received == in_bins(account) > 0")


@pytest.mark.parametrize("emulator", [("quartz16", "unplug_at_s=1.5,unplug_for_s=1.5")], indirect=True)
def test_an_unplugged_board_is_found_again_and_what_is_lost_is_counted(emulator: Emulator, host: UsbHost) -> None:
    host.run(f"start({emulator.link.address!r}, 'quartz16')")
    host.run("read_until(lambda: frames); states.clear()")  # a busy computer may see the bus late, too
    host.run("read_until(lambda: ('waiting', 'no_such_port') in states)")
    host.run("read_until(lambda: states[-1][0] == 'online')")
    host.run("first = frames; read_until(lambda: frames >= first + 200); stop()")
    assert host.value("'unplugged' in [code for _, code in states]")
    assert host.value("account.connections") >= 2
    assert host.value("account.bytes_received == in_bins(account)")
    assert host.value("out_of_place") == []
    assert host.value("missing") == host.value("account.lost.total")
    assert host.value("missing") > 0
