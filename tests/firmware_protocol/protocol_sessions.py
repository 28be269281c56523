"""A host and a board that face each other, for the tests of both."""

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import HostEvent, HostSession
from firmware_protocol.layouts import SINGLE_TONE_STRUCT, Capability, SingleToneRecord
from firmware_protocol.messages import Configuration, CounterKind, Description, Identity
from firmware_protocol.packets import Packet, PacketDecoder

IDENTITY = Identity("test plate", "0042", "1.0", 0)
DESCRIPTION = Description(
    CounterKind.SINGLE_TONE, 4, 1, 10**12, 10**5, 10**8, "quartz16", capabilities=Capability.LOCATE, gate_ticks_step=100
)
RECORD = SingleToneRecord(1, 2, 3, 10, 5, 6, 7, 8, 9, 0)
RECORDS = SINGLE_TONE_STRUCT.pack(*RECORD) * 4
GATE = Configuration(10**6)
BOOT = 0x1234


def new_device(boot_id: int = BOOT, identity: Identity = IDENTITY) -> DeviceSession:
    return DeviceSession(identity, DESCRIPTION, boot_id)


def exchange(host: HostSession, device: DeviceSession) -> list[HostEvent]:
    """Carry bytes both ways until nobody has anything to say."""
    events: list[HostEvent] = []
    while request := host.data_to_send():
        events += host.receive(device.receive(request, board_ticks=500))
    return events


def running(identity: Identity = IDENTITY) -> tuple[HostSession, DeviceSession]:
    host, device = HostSession(), new_device(identity=identity)
    exchange(host, device)
    host.configure(GATE)
    exchange(host, device)
    return host, device


def packets_in(data: bytes, *, from_board: bool = False) -> list[Packet]:
    return [found for found in PacketDecoder(from_board=from_board).feed(data) if isinstance(found, Packet)]


def check_accounts(decoder: PacketDecoder) -> None:
    counts = decoder.counts
    parts = counts.accepted + counts.other_version + counts.echo + counts.discarded
    assert counts.received == parts + decoder.waiting_bytes
