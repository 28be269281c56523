"""State of the daemon: condition, connections to the broker, and conflicts with daemons of the same name."""

import asyncio
import json
import math
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.pacing import TokenBucket
from resonator_daemon.mqtt.payloads import Condition, State
from resonator_daemon.mqtt.topics import HeaderFields

SILENT_S: Final = 90.0  # after which another daemon has ended
RESTORE_S: Final = 30.0  # between restorations; those that something new causes may be two at once
_AT_ONCE: Final = 2

_BOOT_ID_LENGTH_MAX: Final = 64
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


class DaemonState:
    """Announces each change of the daemon's state; to be used from the event loop's thread only.

    A message of another sender on its topic, as a late last will or that of another daemon of this name, has all
    retained messages published again. That also shows this daemon to the other one. The conflict ends when the other
    is offline, or has sent nothing for 90 s. Messages that the broker had retained are ignored: their daemon may have
    ended long ago.

    Parameters
    ----------
    daemon_boot_id
        Of this run.
    publish
        Publishes a snapshot of the state.
    restore
        Publishes all retained messages again.
    """

    def __init__(
        self, daemon_boot_id: str, publish: Callable[[DaemonSnapshot], None], restore: Callable[[], None]
    ) -> None:
        self._daemon_boot_id = daemon_boot_id
        self._publish = publish
        self._restore_others = restore
        self._condition = Condition.STARTING
        self._reason = Reason(ReasonCode.STARTED, "started")
        self._since_utc_ns = time.time_ns()
        self._connections = 0
        self._connected_utc_ns: int | None = None
        self._others: dict[str, asyncio.TimerHandle] = {}  # when each expires, by boot id
        self._at_once = TokenBucket(_AT_ONCE, 1 / RESTORE_S, time.monotonic)
        self._restored_s = -math.inf
        self._due: asyncio.TimerHandle | None = None  # of the next restoration
        self._ended = False

    def answers_for(self, boot_id: str | None) -> bool:
        """Return whether this daemon answers requests for the run with this boot id: unless another one runs it."""
        return boot_id not in self._others

    @property
    def snapshot(self) -> DaemonSnapshot:
        reason = self._reason
        if self._others:
            boot_ids = ", ".join(sorted(self._others))
            text = f"another daemon (boot id {boot_ids}) publishes under this name: {_REMEDY}; {reason.text}"
            reason = Reason(ReasonCode.NAME_CONFLICT, text)
        return DaemonSnapshot(self._condition, reason, self._since_utc_ns, self._connections, self._connected_utc_ns)

    def become(self, condition: Condition, reason: Reason, since_utc_ns: int) -> None:
        self._condition, self._reason, self._since_utc_ns = condition, reason, since_utc_ns
        self._publish(self.snapshot)

    def end(self) -> None:
        """Announce nothing more; the caller publishes the last message."""
        self._ended = True
        self._forget_others()

    def connected(self, number: int) -> None:
        """Announce a new connection to the broker, by its number."""
        self._connections, self._connected_utc_ns = number, time.time_ns()
        self._forget_others()  # those that still run overwrite this state
        self._publish(self.snapshot)

    def receive(self, message: Incoming) -> None:
        """Handle a message on this daemon's `state/daemon`, from any sender."""
        if message.retained or self._ended:
            return
        boot_id, state = _read(message.payload)
        if boot_id == self._daemon_boot_id and state != Condition.OFFLINE:
            return  # its own, which comes back
        is_new = boot_id not in self._others
        if expiry := self._others.pop(boot_id, None):
            expiry.cancel()
        if boot_id and state != Condition.OFFLINE and len(self._others) < _OTHERS_MAX:
            self._others[boot_id] = asyncio.get_running_loop().call_later(SILENT_S, self._expire, boot_id)
        if (is_new or state == Condition.OFFLINE) and self._at_once.try_acquire():
            self._restore()
        elif self._due is None:
            due_s = self._restored_s + RESTORE_S
            self._due = asyncio.get_running_loop().call_at(due_s, self._restore)

    def _restore(self) -> None:
        self._cancel_restoration()
        self._restored_s = asyncio.get_running_loop().time()
        self._publish(self.snapshot)
        self._restore_others()

    def _cancel_restoration(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _expire(self, boot_id: str) -> None:
        del self._others[boot_id]
        self._restore()

    def _forget_others(self) -> None:
        self._cancel_restoration()
        for expiry in self._others.values():
            expiry.cancel()
        self._others.clear()


def _read(payload: bytes) -> tuple[str, object]:
    """Return boot id and state in a message of any sender; an empty boot id if it is none."""
    try:
        content = json.loads(payload)
        boot_id, state = content["daemon_boot_id"], content["state"]
    except (ValueError, RecursionError, TypeError, KeyError):
        return "", None
    if not isinstance(boot_id, str) or not boot_id.isprintable() or len(boot_id) > _BOOT_ID_LENGTH_MAX:
        return "", None
    return boot_id, state
