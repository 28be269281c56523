"""One message of each kind, as the tests of publishing send them: the product's examples with another number."""

import json
from typing import Any

import numpy as np

from resonator_daemon.publishing import payloads
from resonator_daemon.publishing.message_examples import EXAMPLES
from resonator_daemon.publishing.payloads import (
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    DecoderHealth,
    DecoderState,
    Forces,
    Grid,
    Health,
    Info,
    Lost,
    Message,
    Signals,
    State,
)

HEADER: dict[str, Any] = {
    "seq": 1234,
    "daemon_boot_id": "9f3c",
    "board_boot_id": "51aa",
    "t_ns": 1789000000000000000,
    "t_unc_ns": 42000,
    "lost": Lost(),
}


def example(kind: str, **changed: Any) -> Any:
    """Return the example of a model with other values."""
    made = getattr(payloads, kind).model_validate_json(json.dumps(EXAMPLES[kind]))
    header = {key: HEADER[key] for key in ("daemon_boot_id", "board_boot_id") if key in EXAMPLES[kind]}
    return made.model_copy(update=header | changed)


class Messages:
    """Makes messages that differ by one number, `seq` and the values of arrays."""

    @staticmethod
    def state(word: str, reason: str = "") -> State:
        return State(**HEADER, state=word, reason=reason, since_t_ns=1788999990000000000)

    @staticmethod
    def forces(number: int) -> Forces:
        return example("Forces", seq=number)

    @staticmethod
    def contacts(number: int) -> Contacts:
        return example("Contacts", seq=number)

    @staticmethod
    def event(number: int) -> ContactEvent:
        event = example("ContactEvent", seq=number, event="onset", reason="")
        return event.model_copy(update={"contact": event.contact.model_copy(update={"id": number})})

    @staticmethod
    def signals(number: int) -> Signals:
        array = np.full((3, 1024), number, np.float32)
        return Signals(**_measured(number), signals=array, noise_std=np.full((3, 1024), 1e-3), status="ok")

    @staticmethod
    def decoded(number: int) -> Decoded:
        array = np.full((3, 32, 32), number, np.float32)
        return Decoded(
            **_measured(number),
            traction_pascal=array,
            traction_std_pascal=array,
            displacement_m=None,
            grid=Grid(origin_m=(-0.0062, -0.0062), pitch_m=4e-4),
        )

    @staticmethod
    def summary(number: int) -> DecodedSummary:
        return example("DecodedSummary", seq=number)

    @staticmethod
    def info(number: int) -> Info:
        return example("Info", seq=number)

    @staticmethod
    def health(number: int) -> Health:
        return example("Health", seq=number)

    @staticmethod
    def decoder_state(word: str, reason: str = "") -> DecoderState:
        return example("DecoderState", state=payloads.Condition(word), reason=reason)

    @staticmethod
    def decoder_health(number: int) -> DecoderHealth:
        return example("DecoderHealth", uptime_s=float(number))

    @staticmethod
    def by_path() -> dict[str, Message]:
        """Return one message for each topic below `prefix/name/`."""
        return {
            "state/daemon": Messages.state("online"),
            "state/link": Messages.state("waiting", "no such port"),
            "state/sensor": Messages.state("drifting", "warm"),
            "info": Messages.info(1),
            "contacts/event": Messages.event(2),
            "forces": Messages.forces(3),
            "contacts": Messages.contacts(4),
            "signals": Messages.signals(5),
            "decoded": Messages.decoded(6),
            "decoded/summary": Messages.summary(7),
            "health": Messages.health(8),
        }


def _measured(number: int) -> dict[str, Any]:
    return HEADER | {"seq": number, "board_ticks": 1}
