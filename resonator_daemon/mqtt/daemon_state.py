"""State of the daemon: condition, connections to the broker, and conflicts with daemons of the same name."""

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.pacing import TokenBucket
from resonator_daemon.mqtt.payloads import Condition, State
from resonator_daemon.mqtt.topics import HeaderFields

SILENT_S: Final = 90.0  # after which another daemon has ended; a running one restores its state each minute
_PROMPT_AT_ONCE: Final = 2  # announcements that a conflict begins or ends; further ones wait for the restoration
_PROMPT_EVERY_S: Final = 60.0

_BOOT_ID_LENGTH_MAX: Final = 64
_DIGITS_MAX: Final = 19  # of a time in ns
_OTHERS_MAX: Final = 4  # daemons that are stored; any client may forge more

_REMEDY: Final = "stop one of them, or, if they read different boards, give each a name of its own"


class DaemonSnapshot(NamedTuple):
    """Fields of `state/daemon` apart from its header."""

    condition: Condition
    reason: Reason
    since_utc_ns: int
    connections: int
    connected_utc_ns: int | None

    def message(self, header: HeaderFields) -> State:
        """Return the message for `state/daemon` under a header."""
        return State(
            **header,
            state=self.condition,
            reason_code=self.reason.code,
            reason=self.reason.text,
            since_t_ns=self.since_utc_ns,
            connections=self.connections,
            connected_t_ns=self.connected_utc_ns,
        )


@dataclass
class _Other:
    """Another daemon of this name; the values in its messages may be forged."""

    t_ns: int  # of its first message
    connected_utc_ns: int | None
    expiry: asyncio.TimerHandle
    proven: bool = False


class DaemonState:
    """Announces each change of the daemon's state; to be used from the event loop's thread only.

    Two daemons of one name overwrite each other's state, and receive each other's messages. Two messages of another
    boot id with different times are a conflict. It ends when that daemon is offline, or has sent nothing for 90 s. The
    restoration of the overwritten state announces the conflict, and is evidence for the other daemon. Messages that the
    broker had retained are ignored: their daemon may have ended long ago. The daemon with the oldest connection owns
    the name.

    Parameters
    ----------
    daemon_boot_id
        Of this run.
    publish
        Publishes a snapshot of the state.
    restore_now
        Restores at once the retained topics that another daemon of this name has overwritten.
    """

    def __init__(
        self, daemon_boot_id: str, publish: Callable[[DaemonSnapshot], None], restore_now: Callable[[], None]
    ) -> None:
        self._daemon_boot_id = daemon_boot_id
        self._publish = publish
        self._restore_now = restore_now
        self._condition = Condition.STARTING
        self._reason = Reason(ReasonCode.STARTED, "started")
        self._since_utc_ns = time.time_ns()
        self._connections = 0
        self._connected_utc_ns: int | None = None
        self._others: dict[str, _Other] = {}  # by boot id
        self._prompt = TokenBucket(_PROMPT_AT_ONCE, 1 / _PROMPT_EVERY_S, time.monotonic)
        self._ended = False

    def answers_for(self, boot_id: str | None) -> bool:
        """Return whether this daemon answers requests for the run with this boot id; None: requests without one.

        A running daemon answers for its own run. The daemon that owns the name answers all other requests.
        """
        others = self._proven
        if boot_id is not None and (boot_id == self._daemon_boot_id or boot_id in others):
            return boot_id == self._daemon_boot_id
        own_ns = self._connected_utc_ns
        return not any(
            own_ns is None or (other.connected_utc_ns, other_id) < (own_ns, self._daemon_boot_id)
            for other_id, other in others.items()
            if other.connected_utc_ns is not None
        )

    @property
    def snapshot(self) -> DaemonSnapshot:
        reason = self._reason
        if others := self._proven:
            boot_ids = ", ".join(sorted(others))
            text = f"another daemon (boot id {boot_ids}) publishes under this name: {_REMEDY}; {reason.text}"
            reason = Reason(ReasonCode.NAME_CONFLICT, text)
        return DaemonSnapshot(self._condition, reason, self._since_utc_ns, self._connections, self._connected_utc_ns)

    def become(self, condition: Condition, reason: Reason, since_utc_ns: int) -> None:
        self._condition, self._reason, self._since_utc_ns = condition, reason, since_utc_ns
        self._publish(self.snapshot)

    def announce(self) -> None:
        """Publish the state as it is now."""
        if not self._ended:
            self._publish(self.snapshot)

    def end(self) -> None:
        """Announce nothing more; the caller publishes the last message."""
        self._ended = True
        self._remove_all()

    def connected(self, number: int) -> None:
        """Announce a new connection to the broker, by its number."""
        self._connections, self._connected_utc_ns = number, time.time_ns()
        self._remove_all()  # others that still run overwrite this state
        self._publish(self.snapshot)

    def receive(self, message: Incoming) -> None:
        """Handle a message on this daemon's `state/daemon`, from any sender."""
        if message.retained or self._ended:
            return
        try:
            content = json.loads(message.payload)
            boot_id, state, t_ns = content["daemon_boot_id"], content["state"], _utc_ns(content["t_ns"])
        except (ValueError, RecursionError, TypeError, KeyError):
            return
        if not isinstance(boot_id, str) or not boot_id.isprintable() or not 0 < len(boot_id) <= _BOOT_ID_LENGTH_MAX:
            return
        if state == Condition.OFFLINE:
            self._remove(boot_id)
        elif boot_id != self._daemon_boot_id and t_ns is not None:
            self._note(boot_id, t_ns, _utc_ns(content.get("connected_t_ns")))

    @property
    def _proven(self) -> dict[str, _Other]:
        return {boot_id: other for boot_id, other in self._others.items() if other.proven}

    def _note(self, boot_id: str, t_ns: int, connected_utc_ns: int | None) -> None:
        expiry = asyncio.get_running_loop().call_later(SILENT_S, self._expire, boot_id)
        if (other := self._others.get(boot_id)) is None:
            other = self._others[boot_id] = _Other(t_ns, connected_utc_ns, expiry)
        else:
            other.expiry.cancel()
            other.connected_utc_ns, other.expiry = connected_utc_ns, expiry
        if not other.proven and t_ns != other.t_ns:
            is_first = not self._proven
            other.proven = True
            if is_first and self._prompt.try_acquire():
                self.announce()
        if len(self._others) > _OTHERS_MAX:
            self._remove(next(claimed for claimed, other in self._others.items() if not other.proven))

    def _expire(self, boot_id: str) -> None:
        if self._remove(boot_id):
            self.announce()

    def _remove(self, boot_id: str) -> bool:
        """Remove a daemon that is offline or sends nothing; return whether it was a conflict."""
        if (other := self._others.pop(boot_id, None)) is None:
            return False
        other.expiry.cancel()
        if other.proven and not self._proven and self._prompt.try_acquire():
            self._restore_now()
        return other.proven

    def _remove_all(self) -> None:
        for other in self._others.values():
            other.expiry.cancel()
        self._others.clear()


def _utc_ns(text: object) -> int | None:
    """Return the time in a message of any sender; None if it is none."""
    return int(text) if isinstance(text, str) and len(text) <= _DIGITS_MAX and text.isdecimal() else None
