"""Messages made of the published examples, with some of their fields changed."""

from typing import Any, TypeVar

import cbor2
import numpy as np

from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Contact, Lost, Message, Patch, SiteForce

M = TypeVar("M", bound=Message)

NOW_NS = 1_789_000_000_000_000_000

PARTS = {
    SiteForce: EXAMPLES["Forces"]["sites"][0],
    Contact: EXAMPLES["Contacts"]["contacts"][0],
    Patch: EXAMPLES["DecodedSummary"]["patches"][0],
}


def header(**changes: Any) -> dict[str, Any]:
    """Return the fields that every message begins with."""
    fields = {"name": "left-index", "seq": 1, "daemon_boot_id": "9f3c", "t_ns": NOW_NS, "t_uncertainty_ns": 42_000}
    return {**fields, "lost": Lost(), "board_boot_id": "51aa", **changes}


def example(kind: type[M], **changes: Any) -> M:
    """Return the example of a kind of message, or of a part of one."""
    fields = PARTS.get(kind) or EXAMPLES[kind.__name__]
    return kind(**fields | changes)


def as_rows(payload: bytes) -> Any:
    """Read CBOR with arrays as nested rows, by hand."""

    def to_rows(tag: cbor2.CBORTag, _immutable: bool = False) -> Any:
        if tag.tag == 85:
            return np.frombuffer(tag.value, "<f4")
        assert tag.tag == 40
        return tag.value[1].reshape(tag.value[0]).tolist()

    return cbor2.loads(payload, tag_hook=to_rows)
