"""Messages made of the published examples, with some of their fields changed."""

from typing import Any, TypeVar

from resonator_daemon.publishing.message_examples import EXAMPLES
from resonator_daemon.publishing.payloads import Contact, Message, Patch, SiteForce

M = TypeVar("M", bound=Message)

PARTS = {
    SiteForce: EXAMPLES["Forces"]["sites"][0],
    Contact: EXAMPLES["Contacts"]["contacts"][0],
    Patch: EXAMPLES["DecodedSummary"]["patches"][0],
}


def example(kind: type[M], **changes: Any) -> M:
    """Return the example of a kind of message, or of a part of one."""
    fields = PARTS.get(kind) or EXAMPLES[kind.__name__]
    return kind(**fields | changes)
