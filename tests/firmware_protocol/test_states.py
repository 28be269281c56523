"""Both sessions do what the tables say, for every pair of state and request or cue."""

from collections.abc import Callable

import pytest
from protocol_sessions import BOOT, GATE, IDENTITY, new_device, packets_in

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import HostSession
from firmware_protocol.layouts import FROM_BOARD, MessageType
from firmware_protocol.messages import Refusal, RefusalCode, encode_message
from firmware_protocol.packets import encode_packet
from firmware_protocol.states import BOARD, HOST, BoardState, Cue, HostState

REQUESTS = [member for member in MessageType if not member & FROM_BOARD]
PAYLOADS = {MessageType.CONFIGURE: encode_message(GATE), MessageType.PING: bytes(8)}


def device_in(state: BoardState) -> DeviceSession:
    device = new_device()
    if state is not BoardState.IDLE:
        device.receive(encode_packet(MessageType.CONFIGURE, 1, encode_message(GATE)), 0)
    if state is BoardState.RUNNING:
        device.receive(encode_packet(MessageType.START, 2), 0)
    assert device.state is state
    return device


@pytest.mark.parametrize("request_type", REQUESTS)
@pytest.mark.parametrize("state", BoardState)
def test_board_reacts_as_the_table_states(state: BoardState, request_type: MessageType) -> None:
    reaction = BOARD[state, request_type]
    device = device_in(state)
    request = encode_packet(request_type, 77, PAYLOADS.get(request_type, b""))
    (answer,) = packets_in(device.receive(request, 5), from_board=True)
    assert (answer.type, answer.sequence, answer.boot_id, answer.board_ticks) == (reaction.answer, 77, BOOT, 5)
    assert device.state is reaction.next_state
    if reaction.refusal is not None:
        assert answer.payload[2] == reaction.refusal


STEPS_TO = {
    HostState.IDENTIFYING: 0, HostState.DESCRIBING: 1, HostState.DESCRIBED: 2, HostState.CONFIGURING: 2,
    HostState.STARTING: 3, HostState.RUNNING: 4
}  # fmt: skip


def host_in(state: HostState) -> tuple[HostSession, DeviceSession, MessageType | None]:
    """Return a host in that state, its board, and the request that the state waits for."""
    host, device = HostSession(), new_device()
    if state is HostState.REFUSED:
        refused = encode_packet(MessageType.REFUSED, 1, encode_message(Refusal(RefusalCode.FAULT, "")), boot_id=BOOT)
        host.data_to_send()
        host.receive(refused)
    else:
        for step in range(STEPS_TO[state]):
            if step == 2:
                host.configure(GATE)
            host.receive(device.receive(host.data_to_send(), 0))
        if state is HostState.CONFIGURING:
            host.configure(GATE)
    assert host.state is state
    sent = packets_in(host.data_to_send())
    return host, device, MessageType(sent[-1].type) if sent else None


def answer_packet(answer: MessageType, number: int) -> bytes:
    payloads = {
        MessageType.IDENTITY: encode_message(IDENTITY),
        MessageType.CONFIGURED: encode_message(GATE),
        MessageType.REFUSED: encode_message(Refusal(RefusalCode.FAULT, "")),
    }
    device = new_device()
    described = packets_in(device.receive(encode_packet(MessageType.DESCRIBE, 1), 0), from_board=True)
    payloads[MessageType.DESCRIPTION] = described[0].payload
    return encode_packet(answer, number, payloads.get(answer, b""), boot_id=BOOT)


USER: dict[Cue, Callable[[HostSession], None]] = {
    Cue.CONFIGURE: lambda host: host.configure(GATE),
    Cue.RESUME: lambda host: host.resume(),
    Cue.STOP: lambda host: host.stop(),
}


@pytest.mark.parametrize("cue", Cue)
@pytest.mark.parametrize("state", HostState)
def test_host_moves_as_the_table_states(state: HostState, cue: Cue) -> None:
    host, _, _ = host_in(state)
    if cue is Cue.STARTED and state is HostState.RUNNING:
        host.resume()
    number = 1
    if host.awaits_answer:
        host.data_to_send()
        host.ask_again()  # tells the number that is waited for
        number = packets_in(host.data_to_send())[-1].sequence
    step = HOST.get((state, cue))
    if cue in USER:
        if step is None:
            with pytest.raises(ValueError, match=f"the session must be .*, it is {state.value}"):
                USER[cue](host)
        else:
            USER[cue](host)
    elif cue is Cue.REBOOT:
        host.receive(encode_packet(MessageType.STOPPED, 0, boot_id=BOOT))
        host.receive(encode_packet(MessageType.STOPPED, 0, boot_id=BOOT + 1))
    elif cue is Cue.REFUSED and state is HostState.RUNNING:
        host.resume()
        host.receive(answer_packet(MessageType.REFUSED, packets_in(host.data_to_send())[-1].sequence))
    else:
        host.receive(answer_packet(MessageType[cue.value], number))
    sent = packets_in(host.data_to_send())
    assert host.state is (step.next_state if step else state)
    if cue is not Cue.REFUSED:
        assert [packet.type for packet in sent] == ([step.sends] if step and step.sends else [])


@pytest.mark.parametrize("answer", [MessageType.DESCRIPTION, MessageType.STARTED, MessageType.STOPPED])
def test_another_answer_under_the_right_number_moves_nothing(answer: MessageType) -> None:
    host, _, _ = host_in(HostState.IDENTIFYING)
    host.receive(answer_packet(answer, 1))
    assert (host.state, host.messages.stale) == (HostState.IDENTIFYING, 1)
    assert host.receive(answer_packet(MessageType.REFUSED, 2)) == []  # nor does a refusal of what was not asked
    assert host.messages.stale == 2
