"""One message of each kind, as the tests of publishing send them: the product's examples with another number."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from example_messages import example, header

from resonator_daemon.mqtt import payloads

M = TypeVar("M", bound=payloads.Message)
HEADER = header(seq=1234)


def numbered(kind: type[M]) -> Callable[[int], M]:
    """Return what makes messages of a kind that differ by `seq`."""
    return lambda number: example(kind, seq=number)


class Messages:
    """Makes messages that differ by one number, `seq` and the values of arrays."""

    forces = staticmethod(numbered(payloads.Forces))
    contacts = staticmethod(numbered(payloads.Contacts))
    tones = staticmethod(numbered(payloads.Tones))
    summary = staticmethod(numbered(payloads.DecodedSummary))
    info = staticmethod(numbered(payloads.Info))
    health = staticmethod(numbered(payloads.Health))

    @staticmethod
    def state(word: str, reason: str = "") -> payloads.State:
        return payloads.State(**HEADER, state=word, reason=reason, since_t_ns=1788999990000000000)

    @staticmethod
    def event(number: int) -> payloads.ContactEvent:
        event = example(payloads.ContactEvent, seq=number, event="onset", reason="")
        return event.model_copy(update={"contact": event.contact.model_copy(update={"id": number})})

    @staticmethod
    def signals(number: int) -> payloads.Signals:
        array, noise = np.full((3, 1024), number, np.float32), np.full((3, 1024), 1e-3)
        return payloads.Signals(**header(seq=number), board_ticks=1, signals=array, noise_std=noise, status="ok")

    @staticmethod
    def decoded(number: int) -> payloads.Decoded:
        array = np.full((3, 32, 32), number, np.float32)
        return payloads.Decoded(
            **header(seq=number),
            board_ticks=1,
            traction_pascal=array,
            traction_std_pascal=array,
            displacement_m=None,
            grid=payloads.Grid(origin_m=(-0.0062, -0.0062), pitch_m=4e-4),
        )

    @staticmethod
    def decoder_state(word: str, reason: str = "") -> payloads.DecoderState:
        return example(payloads.DecoderState, state=payloads.Condition(word), reason=reason)

    @staticmethod
    def decoder_health(number: int) -> payloads.DecoderHealth:
        return example(payloads.DecoderHealth, uptime_s=float(number))

    @staticmethod
    def by_path() -> dict[str, payloads.Message]:
        """Return one message for each topic below `prefix/name/`."""
        return {
            "state/daemon": Messages.state("online"), "state/link": Messages.state("waiting", "no such port"),
            "state/sensor": Messages.state("drifting", "warm"), "info": Messages.info(1),
            "contacts/event": Messages.event(2), "forces": Messages.forces(3), "contacts": Messages.contacts(4),
            "tones": Messages.tones(4), "signals": Messages.signals(5), "decoded": Messages.decoded(6),
            "decoded/summary": Messages.summary(7), "health": Messages.health(8)
        }  # fmt: skip
