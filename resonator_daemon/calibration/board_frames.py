"""Frames of the board that is calibrated, straight from its link."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from resonator_daemon.calibration.refusal import CalibrationRefusedError, LinkBusyError
from resonator_daemon.conditions import Condition
from resonator_daemon.config import Config
from resonator_daemon.errors import ConfigurationError, IncompatibleBoardError
from resonator_daemon.recording.event_replay import replay_of
from resonator_daemon.session.blocking_reader import BlockingReader
from resonator_daemon.session.frames import (
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    Frame,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)

FromBoard = BoardOnline | Frame

OPEN_S: Final = 10.0  # in which a board must answer
_TURN_S: Final = 0.2


@contextmanager
def board_frames(config: Config, timeout_s: float) -> Iterator[Iterator[FromBoard]]:
    """Give what the board says of itself, then its frames as they come; SIGTERM and SIGHUP end it like Ctrl-C."""
    replay = replay_of(config.link, config.plate)
    loop = BlockingReader(
        config.link, config.plate, any_unit=True, replay=replay
    )  # another board may be calibrated anew
    handlers = {number: signal.signal(number, _interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        with loop:
            yield _arrivals(loop, timeout_s)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _arrivals(loop: BlockingReader, timeout_s: float) -> Iterator[FromBoard]:
    state = LinkChange(Condition.STARTING, "the link is being opened", 0, 0)
    online = False
    last_s = time.monotonic()
    while True:
        for arrival in loop.wait(_TURN_S):
            match arrival:
                case SingleToneFrame() | ChannelisedFrame():
                    last_s = time.monotonic()
                    yield arrival
                case BoardOnline():
                    online = True
                    yield arrival
                case BoardRefused():
                    raise (IncompatibleBoardError if arrival.other_protocol else ConfigurationError)(*arrival.problems)
                case LinkChange():
                    state = arrival
                    if arrival.state == "waiting" and not online:
                        remedy = "a calibration needs the link for itself: stop the daemon that runs on it"
                        raise LinkBusyError(f"link: {arrival.reason}; {remedy}")
                case ReaderFailed():
                    raise arrival.error
        if time.monotonic() - last_s > (timeout_s if online else OPEN_S):
            raise CalibrationRefusedError(
                f"link {state.state}: {state.reason}; no frame came; the plate file is as before"
            )
