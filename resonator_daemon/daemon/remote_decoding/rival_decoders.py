"""Other decoder processes that follow the same plates, by the states that they publish."""

import json
from typing import Final

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.mqtt.mqtt_messages import Incoming
from resonator_daemon.mqtt.payloads import Condition
from resonator_daemon.mqtt.topics import DECODER_EXPIRY_S

_ID_LENGTH_MAX: Final = 120
_NAMED_MAX: Final = 4  # any client can publish states of more


class RivalDecoders:
    """Other decoders of the same signals, by their states, which they repeat within `DECODER_EXPIRY_S`.

    A live state adds a decoder, `offline` removes it. Retained states add none: their decoder may have ended, and one
    that runs publishes again when it receives the state of this one.

    Parameters
    ----------
    decoder_id
        Id of this process.
    topic_filter
        Topics of its signals, separated by spaces.
    """

    def __init__(self, decoder_id: str, topic_filter: str) -> None:
        self._decoder_id = decoder_id
        self._topic_filters = set(topic_filter.split())
        self._seen_s: dict[str, float] = {}  # arrival of the last state, by id

    def receive(self, message: Incoming, now_s: float) -> None:
        """Handle the state of any decoder."""
        try:
            content = json.loads(message.payload)
            other, state, taken = content["decoder_id"], content["state"], content["topic_filter"]
        except (ValueError, RecursionError, TypeError, KeyError):
            return
        if not isinstance(other, str) or not other.isprintable() or not 0 < len(other) <= _ID_LENGTH_MAX:
            return
        if state == Condition.OFFLINE or self._topic_filters.isdisjoint(str(taken).split()):
            self._seen_s.pop(other, None)
        elif other in self._seen_s or (
            other != self._decoder_id and not message.retained and len(self._seen_s) < _NAMED_MAX
        ):
            self._seen_s[other] = now_s

    def remark(self, now_s: float) -> Reason | None:
        """Return a reason that lists the other decoders; None without one."""
        self._seen_s = {other: at_s for other, at_s in self._seen_s.items() if now_s - at_s < DECODER_EXPIRY_S}
        if not self._seen_s:
            return None
        others = ", ".join(sorted(self._seen_s))
        what = "this plate" if len(self._topic_filters) == 1 else "some of these plates"
        text = f"decoder {others} follows {what}, too, and both publish: stop one of them"
        return Reason(ReasonCode.SECOND_DECODER, text)
