"""Reasons of the states of a link, as codes and sentences."""

from collections.abc import Iterable
from typing import Annotated, Any, Final

from pydantic import BeforeValidator

from firmware_protocol.host import PacketRefusal
from resonator_daemon.base.reasons import Reason, ReasonCode, joined

UNANSWERED_S: Final = 10  # without an answer, though frames come

_OF_PACKETS: Final = {
    "frame_length": ReasonCode.FRAME_LENGTH,
    "frame_part": ReasonCode.FRAME_PART,
    "frame_kind": ReasonCode.FRAME_KIND,
    "frame_ticks": ReasonCode.FRAME_TICKS,
    "message_fields": ReasonCode.MESSAGE_FIELDS,
}

OPENING: Final = Reason(ReasonCode.OPENING, "the link is being opened")


def all_of(reasons: Iterable[Reason]) -> Reason:
    """Return several reasons as one, under the code of the first."""
    return joined(*reasons) or Reason(ReasonCode.UNSPECIFIED, "")


def restarted(cause: str = "") -> Reason:
    """Return the reason of a board that restarted."""
    return Reason(ReasonCode.BOARD_RESTARTED, f"the board restarted{cause}")


def configuring(serial_number: str, firmware: str) -> Reason:
    """Return the reason while a board is being configured."""
    return Reason(ReasonCode.CONFIGURING, f"board {serial_number} with firmware {firmware} is being configured")


def counting(
    serial_number: str,
    frame_rate_hz: float,
    *,
    rate_doubt: str | None,
    is_unanswered: bool,
    refused: PacketRefusal | None,
    busy: Reason | None,
) -> Reason:
    """Return the reason of a link whose frames arrive; its code is that of the last doubt, if there is one."""
    code, sentences = ReasonCode.BOARD_COUNTS, [f"board {serial_number} sends {frame_rate_hz:g} frames/s"]
    if rate_doubt:
        code = ReasonCode.TICK_RATE
        sentences.append(rate_doubt)
    if is_unanswered:
        code = ReasonCode.NO_PONG
        sentences.append(f"no ping was answered for {UNANSWERED_S} s: is the line to the board broken?")
    if refused:
        code, text = _packets_refused(refused)
        sentences.append(text)
    if busy:
        code = busy.code
        sentences.append(busy.text)
    return Reason(code, "; ".join(sentences))


def no_frame(refused: PacketRefusal | None, busy: Reason | None) -> Reason:
    """Return the reason of an open link without frames, with what may explain it."""
    text = "the port is open and no frame comes"
    cause = _packets_refused(refused) if refused is not None else busy
    return Reason(cause.code, f"{text}; {cause.text}") if cause else Reason(ReasonCode.NO_FRAMES, text)


def silence(bytes_received: int, refused: PacketRefusal | None, described: str | None) -> Reason:
    """Return why a handshake came to no end; `described` is the serial number of a board that lacks a pong alone."""
    if refused is not None:
        text = f"no board answers: its packets are refused ({refused.code}): {refused.text}; update its firmware"
        return Reason(_OF_PACKETS[refused.code], text)
    if described is not None:
        text = f"board {described} identifies itself but answers no ping (no_pong); update its firmware"
        return Reason(ReasonCode.NO_PONG, text)
    received = f"{bytes_received} bytes came and no answer" if bytes_received else "not a byte came"
    question = "is it a board of this kind, and the baud rate right?"
    return Reason(ReasonCode.NO_BOARD_ANSWERS, f"no board answers: {received}; {question}")


def _packets_refused(refused: PacketRefusal) -> Reason:
    return Reason(_OF_PACKETS[refused.code], f"packets are refused ({refused.code}): {refused.text}")


def _complete(stored: Any) -> Reason:
    """Return a stored reason with a code that this version has."""
    match stored:
        case str():
            return Reason(ReasonCode.UNSPECIFIED, stored)
        case [str() as code, str() as text]:
            return Reason(ReasonCode(code), text)
    raise ValueError("a reason is [code, text]")


StoredReason = Annotated[Reason, BeforeValidator(_complete)]
"""A reason that is written as [code, text]; a text alone can be read, too."""
