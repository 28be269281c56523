"""Both ends' state machines as data; device.py and host.py execute them, PROTOCOL.md prints them."""

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import RefusalCode


class BoardState(Enum):
    """What the board is doing."""

    IDLE = "idle"
    CONFIGURED = "configured"
    RUNNING = "running"


class Reaction(NamedTuple):
    """A board's answer to a request that is well formed and within its limits, and the state after it."""

    answer: MessageType
    next_state: BoardState
    refusal: RefusalCode | None = None


_IDLE, _CONFIGURED, _RUNNING = BoardState

# Every request sets a state rather than changing one, so that a repeated one has no second effect.
BOARD: Mapping[tuple[BoardState, int], Reaction] = {
    **{
        (state, request): Reaction(answer, state)
        for state in BoardState
        for request, answer in (
            (MessageType.IDENTIFY, MessageType.IDENTITY),
            (MessageType.DESCRIBE, MessageType.DESCRIPTION),
            (MessageType.PING, MessageType.PONG),
            (MessageType.LOCATE, MessageType.LOCATED),
        )
    },
    **{(state, MessageType.CONFIGURE): Reaction(MessageType.CONFIGURED, _CONFIGURED) for state in BoardState},
    (_IDLE, MessageType.START): Reaction(MessageType.REFUSED, _IDLE, RefusalCode.NOT_IN_THIS_STATE),
    (_CONFIGURED, MessageType.START): Reaction(MessageType.STARTED, _RUNNING),
    (_RUNNING, MessageType.START): Reaction(MessageType.STARTED, _RUNNING),
    (_IDLE, MessageType.STOP): Reaction(MessageType.STOPPED, _IDLE),
    (_CONFIGURED, MessageType.STOP): Reaction(MessageType.STOPPED, _CONFIGURED),
    (_RUNNING, MessageType.STOP): Reaction(MessageType.STOPPED, _CONFIGURED),
}


class HostState(Enum):
    """Where the host is in the handshake."""

    IDENTIFYING = "identifying"
    DESCRIBING = "describing"
    DESCRIBED = "described"
    CONFIGURING = "configuring"
    STARTING = "starting"
    RUNNING = "running"
    REFUSED = "refused"


class Cue(Enum):
    """What moves a host: an answer to its pending request, a new boot, or its user."""

    IDENTITY = "IDENTITY"
    DESCRIPTION = "DESCRIPTION"
    CONFIGURED = "CONFIGURED"
    STARTED = "STARTED"
    REFUSED = "REFUSED"
    REBOOT = "another boot_id"
    CONFIGURE = "user configures"
    RESUME = "user resumes"
    STOP = "user stops"


class Step(NamedTuple):
    """The state after a cue, and the request that goes out with it."""

    next_state: HostState
    sends: MessageType | None = None


_QUIET = (HostState.IDENTIFYING, HostState.DESCRIBING, HostState.DESCRIBED, HostState.REFUSED)

# A pair that is not here changes nothing: an answer is stale then, a user's call is a programming error.
HOST: Mapping[tuple[HostState, Cue], Step] = {
    (HostState.IDENTIFYING, Cue.IDENTITY): Step(HostState.DESCRIBING, MessageType.DESCRIBE),
    (HostState.DESCRIBING, Cue.DESCRIPTION): Step(HostState.DESCRIBED),
    (HostState.DESCRIBED, Cue.CONFIGURE): Step(HostState.CONFIGURING, MessageType.CONFIGURE),
    (HostState.CONFIGURING, Cue.CONFIGURED): Step(HostState.STARTING, MessageType.START),
    (HostState.STARTING, Cue.STARTED): Step(HostState.RUNNING),
    (HostState.RUNNING, Cue.RESUME): Step(HostState.RUNNING, MessageType.START),
    (HostState.RUNNING, Cue.STARTED): Step(HostState.RUNNING),
    **{
        (state, Cue.REFUSED): Step(HostState.REFUSED)
        for state in HostState
        if state not in (HostState.DESCRIBED, HostState.REFUSED)
    },
    **{(state, Cue.REBOOT): Step(HostState.IDENTIFYING, MessageType.IDENTIFY) for state in HostState},
    **{
        (state, Cue.STOP): Step(state if state in _QUIET else HostState.DESCRIBED, MessageType.STOP)
        for state in HostState
    },
}
