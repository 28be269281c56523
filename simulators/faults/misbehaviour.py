"""Deviations from the protocol, in the answers that a board sends and in the gates that it counts."""

from collections.abc import Collection
from dataclasses import replace

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import (
    Configuration,
    Description,
    Identity,
    Refusal,
    RefusalCode,
    decode_message,
    encode_message,
)
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from simulators.faults.plan import Violation

_CHANGED_REFERENCE = 1.001
_OTHER_PLATE = "another-plate"


class Misbehaviour:
    """Replaces the answers and gates of a correct board by those of this one."""

    def __init__(self, violations: Collection[Violation] = ()) -> None:
        self._violations = frozenset(violations)
        self._descriptions = 0

    def identity(self, identity: Identity) -> Identity:
        return replace(identity, product="another product") if "other_product" in self._violations else identity

    def description(self, description: Description) -> Description:
        channels = (
            0 if "channels0" in self._violations else 5 if "channels5" in self._violations else description.channels
        )
        plate = _OTHER_PLATE if "other_plate" in self._violations else description.plate
        return replace(description, channels=channels, plate=plate)

    def boot_id(self, drawn: int, last: int) -> int:
        return last if "same_boot_id" in self._violations else drawn

    def gate_ticks(self, configured: int) -> int:
        """Return how long the gates are that are counted."""
        if "other_gate" in self._violations:
            return 2 * configured
        return max(1, configured // 2) if "hidden_gate" in self._violations else configured

    def answers(self, answers: list[bytes]) -> list[bytes]:
        """Return what is sent instead of the correct answers."""
        return [self._answer(answer) for answer in answers] if self._violations else answers

    def _answer(self, answer: bytes) -> bytes:
        (packet,) = PacketDecoder(from_board=True).feed(answer)
        if not isinstance(packet, Packet):
            raise ValueError(f"an answer must be one sound packet from a board, got {packet}")
        kind, payload = packet.type, packet.payload
        if kind == MessageType.DESCRIPTION:
            self._descriptions += 1
            if "reference_changes" in self._violations and self._descriptions > 1:
                description = decode_message(Description, payload)
                reference_millihertz = round(description.reference_millihertz * _CHANGED_REFERENCE)
                payload = encode_message(replace(description, reference_millihertz=reference_millihertz))
        elif kind == MessageType.CONFIGURED:
            gate_ticks = decode_message(Configuration, payload).gate_ticks
            if "other_gate" in self._violations:
                payload = encode_message(Configuration(self.gate_ticks(gate_ticks)))
            if "limits" in self._violations:
                kind = MessageType.REFUSED
                payload = encode_message(Refusal(RefusalCode.OUT_OF_RANGE, f"gate_ticks {gate_ticks} is out of range"))
        return encode_packet(kind, packet.sequence, payload, board_ticks=packet.board_ticks, boot_id=packet.boot_id)
