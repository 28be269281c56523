"""The daemon's own state: what it is doing, how often it connected to the broker, and whether another has its name."""

import json
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from resonator_daemon.publishing.headers import BoardFields
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.payloads import Condition, State
from resonator_daemon.reasons import Reason, ReasonCode

_BOOT_ID_LENGTH_MAX: Final = 64
_DIGITS_MAX: Final = 19  # of a time in ns
_OTHERS_MAX: Final = 4  # that are named; nobody runs more under one name, but anyone may claim to

_REMEDY: Final = "stop one of them, or, if they read different boards, give each a name of its own"


class DaemonSnapshot(NamedTuple):
    """Fields of `state/daemon` apart from its header."""

    condition: Condition
    reason: Reason
    since_utc_ns: int
    connections: int
    connected_utc_ns: int | None

    def message(self, header: BoardFields) -> State:
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

    Two daemons of one name overwrite each other's states. Each subscribes to its own `state/daemon`: a live
    message of another boot id is a conflict, announced once by both, until the other is offline. Any other
    `offline` is a will that came late, of an earlier run or connection: the present state is announced again. What the
    broker had retained is ignored: it may be of a daemon that is long gone. Of several daemons the one whose connection
    is the oldest owns the name.

    Parameters
    ----------
    daemon_boot_id
        Of this run.
    announce
        Publishes a snapshot of the state.
    republish
        Publishes again what is retained under this name: another wrote over it.
    """

    def __init__(
        self, daemon_boot_id: str, announce: Callable[[DaemonSnapshot], None], republish: Callable[[], None]
    ) -> None:
        self._daemon_boot_id = daemon_boot_id
        self._announce = announce
        self._republish = republish
        self._condition = Condition.STARTING
        self._reason = Reason(ReasonCode.STARTED, "started")
        self._since_utc_ns = time.time_ns()
        self._connections = 0
        self._connected_utc_ns: int | None = None
        self._others: dict[str, int | None] = {}  # when each connected, by boot id
        self._ended = False

    @property
    def conflict(self) -> bool:
        """Whether another daemon publishes under this name."""
        return bool(self._others)

    def answers_for(self, boot_id: str | None) -> bool:
        """Return whether this daemon, and no other of its name, answers for a run; None: for whichever lasts.

        A run that lasts answers for itself. For all else the daemon that owns the name answers.
        """
        if boot_id is not None and (boot_id == self._daemon_boot_id or boot_id in self._others):
            return boot_id == self._daemon_boot_id
        own_ns = self._connected_utc_ns
        return not any(
            own_ns is None or (connected_ns, other) < (own_ns, self._daemon_boot_id)
            for other, connected_ns in self._others.items()
            if connected_ns is not None
        )

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
        self._announce(self.snapshot)

    def end(self) -> None:
        """Stop announcing: the next message is the last."""
        self._ended = True

    def connected(self, number: int) -> None:
        """Announce a new connection to the broker, by its number."""
        self._connections, self._connected_utc_ns = number, time.time_ns()
        self._others.clear()  # any other that still runs announces itself again when it receives this state
        self._announce(self.snapshot)

    def receive(self, message: Incoming) -> None:
        """Handle a message on this daemon's `state/daemon`, from any sender."""
        if message.retained or self._ended:
            return
        try:
            content = json.loads(message.payload)
            boot_id, state = content["daemon_boot_id"], content["state"]
        except (ValueError, RecursionError, TypeError, KeyError):
            return
        if not isinstance(boot_id, str) or not boot_id.isprintable() or not 0 < len(boot_id) <= _BOOT_ID_LENGTH_MAX:
            return
        if state == Condition.OFFLINE:
            if boot_id in self._others:
                del self._others[boot_id]
            if boot_id != self._daemon_boot_id:
                self._republish()
            self._announce(self.snapshot)
        elif boot_id in self._others:
            self._others[boot_id] = _utc_ns(content.get("connected_t_ns"))
        elif boot_id != self._daemon_boot_id and len(self._others) < _OTHERS_MAX:
            self._others[boot_id] = _utc_ns(content.get("connected_t_ns"))
            self._announce(self.snapshot)


def _utc_ns(text: object) -> int | None:
    """Return a time of a message of any sender; None where it is none."""
    return int(text) if isinstance(text, str) and len(text) <= _DIGITS_MAX and text.isdecimal() else None
