"""The daemon's own state: what it is doing, how often it connected to the broker, and whether another has its name."""

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.mqtt.headers import BoardFields
from resonator_daemon.mqtt.mqtt_messages import Incoming
from resonator_daemon.mqtt.payloads import Condition, State
from resonator_daemon.mqtt.token_bucket import TokenBucket

SILENT_S: Final = 90.0  # then another daemon is gone; while it runs, it restores its state at least once a minute
_PROMPT_AT_ONCE: Final = 2  # announcements that a conflict has begun or ended; more of them wait for the restoration
_PROMPT_EVERY_S: Final = 60.0

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


@dataclass
class _Other:
    """A daemon of the same name; what it claims may be forged."""

    t_ns: int  # of its first message
    connected_utc_ns: int | None
    forget: asyncio.TimerHandle
    proven: bool = False


class DaemonState:
    """Announces each change of the daemon's state; to be used from the event loop's thread only.

    Two daemons of one name overwrite each other's states, and both receive them. Messages of another boot id with two
    different times are a conflict, until that daemon is offline or silent. Each message overwrites the own state; its
    restoration announces what has changed, and is evidence for the other daemon. What the broker had retained is
    ignored: it may be of a daemon that is long gone. Of several daemons the one whose connection is the oldest owns the
    name.

    Parameters
    ----------
    daemon_boot_id
        Of this run.
    publish
        Publishes a snapshot of the state.
    restore_now
        Restores at once what another daemon of the name, which has ended, overwrote last, this state included.
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
        """Return whether this daemon, and no other of its name, answers for a run; None: for whichever lasts.

        A run that lasts answers for itself. For all else the daemon that owns the name answers.
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
        """Stop announcing: the next message is the last."""
        self._ended = True
        self._forget_all()

    def connected(self, number: int) -> None:
        """Announce a new connection to the broker, by its number."""
        self._connections, self._connected_utc_ns = number, time.time_ns()
        self._forget_all()  # any other that still runs answers this state with its own
        self._publish(self.snapshot)

    def receive(self, message: Incoming) -> None:
        """Handle a message on this daemon's `state/daemon`, from any sender; whatever it is, it is overwritten."""
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
            self._forget(boot_id)
        elif boot_id != self._daemon_boot_id and t_ns is not None:
            self._note(boot_id, t_ns, _utc_ns(content.get("connected_t_ns")))

    @property
    def _proven(self) -> dict[str, _Other]:
        return {boot_id: other for boot_id, other in self._others.items() if other.proven}

    def _note(self, boot_id: str, t_ns: int, connected_utc_ns: int | None) -> None:
        forget = asyncio.get_running_loop().call_later(SILENT_S, self._fell_silent, boot_id)
        if (other := self._others.get(boot_id)) is None:
            other = self._others[boot_id] = _Other(t_ns, connected_utc_ns, forget)
        else:
            other.forget.cancel()
            other.connected_utc_ns, other.forget = connected_utc_ns, forget
        if not other.proven and t_ns != other.t_ns:
            is_first = not self._proven
            other.proven = True
            if is_first and self._prompt.try_acquire():
                self.announce()
        if len(self._others) > _OTHERS_MAX:
            self._forget(next(claimed for claimed, other in self._others.items() if not other.proven))

    def _fell_silent(self, boot_id: str) -> None:
        if self._forget(boot_id):
            self.announce()

    def _forget(self, boot_id: str) -> bool:
        """Remove a daemon that is offline or silent; return whether it was a conflict."""
        if (other := self._others.pop(boot_id, None)) is None:
            return False
        other.forget.cancel()
        if other.proven and not self._proven and self._prompt.try_acquire():
            self._restore_now()
        return other.proven

    def _forget_all(self) -> None:
        for other in self._others.values():
            other.forget.cancel()
        self._others.clear()


def _utc_ns(text: object) -> int | None:
    """Return a time of a message of any sender; None where it is none."""
    return int(text) if isinstance(text, str) and len(text) <= _DIGITS_MAX and text.isdecimal() else None
