"""Tone readings of the board that is calibrated, straight from its link."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from resonator_daemon.calibration.refusal import CalibrationRefusedError, LinkBusyError
from resonator_daemon.conditions import Condition
from resonator_daemon.config import Config
from resonator_daemon.errors import ConfigurationError, IncompatibleBoardError
from resonator_daemon.pipeline.tone_capture import ToneCapture
from resonator_daemon.recording.event_replay import replay_of
from resonator_daemon.session.frames import BoardOnline, BoardRefused, ChannelisedFrame, LinkChange, SingleToneFrame
from resonator_daemon.session.link_reasons import OPENING
from resonator_daemon.tones.tone_detector import ToneReading

OPEN_S: Final = 10.0  # in which a board must answer


@contextmanager
def board_readings(config: Config, timeout_s: float) -> Iterator[Iterator[BoardOnline | ToneReading]]:
    """Yield an iterator over the board and then its readings."""
    with ToneCapture(config.link, config.plate, replay=replay_of(config.link, config.plate)) as capture:
        yield _readings(capture, timeout_s)


def _readings(capture: ToneCapture, timeout_s: float) -> Iterator[BoardOnline | ToneReading]:
    state = LinkChange(Condition.STARTING, OPENING, 0, 0)
    online = False
    last_s = time.monotonic()
    for arrival, reading in capture.arrivals():
        match arrival:
            case SingleToneFrame() | ChannelisedFrame():
                last_s = time.monotonic()
                if reading is not None:
                    yield reading
            case BoardOnline():
                online = True
                yield arrival
            case BoardRefused():
                error = IncompatibleBoardError if arrival.other_protocol else ConfigurationError
                raise error(*(problem.text for problem in arrival.problems))
            case LinkChange():
                state = arrival
                if arrival.state is Condition.WAITING and not online:
                    remedy = "a calibration needs the link for itself: stop the daemon that runs on it"
                    raise LinkBusyError(
                        f"link: {arrival.reason.text}; {remedy}", in_use=arrival.reason.code == "port_in_use"
                    )
            case None if time.monotonic() - last_s > (timeout_s if online else OPEN_S):
                raise CalibrationRefusedError(
                    f"link {state.state}: {state.reason.text}; no frame came; the plate file is as before"
                )
