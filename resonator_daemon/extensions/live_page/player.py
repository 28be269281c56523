"""Playing recordings to one browser: position, speed, pause and seek."""

import asyncio
from collections.abc import Callable, Collection
from typing import Any, Final

from resonator_daemon.extensions.live_page.library import Recorded
from resonator_daemon.extensions.live_page.protocol import Outgoing, payload_frame, text_frame
from resonator_daemon.mqtt.topics import TOPICS

TURN_S: Final = 1 / 60
POSITION_S: Final = 0.1


class Player:
    """Position of one browser in one recording; plays from the beginning on.

    Parameters
    ----------
    source
        `a` or `b`.
    recorded
        What is played.
    outgoing
        Of the browser.
    watches
        Returns whether the browser has asked for a stream, by source, plate and path.
    """

    def __init__(
        self, source: str, recorded: Recorded, outgoing: Outgoing, watches: Callable[[str, str, str], bool]
    ) -> None:
        self.recorded = recorded
        self._source = source
        self._outgoing = outgoing
        self._watches = watches
        self._t_ns = 0
        self._sent = dict.fromkeys(recorded.tracks, 0)  # by path: messages before the next one to send
        self._playing = True
        self._speed = 1.0
        self._jumped = True  # to where nothing was sent
        self._reported_s, self._reported = 0.0, ""

    def play(self, playing: bool, speed: float | None) -> None:
        """Play or pause; at the end, play from the beginning."""
        if playing and self._ended:
            self.seek(0.0)
        self._playing = playing
        self._speed = self._speed if speed is None else speed

    def seek(self, t_s: float) -> None:
        """Go on at a time since the beginning; beyond the end: at the end."""
        self._t_ns = min(max(round(t_s * 1e9), 0), self.recorded.end_ns)
        self._jumped = True

    def watch(self) -> None:
        """Send the newest messages of the streams that the browser now asks for."""
        self._jumped = True

    @property
    def speed(self) -> float | None:
        """Seconds of the recording a second; None while it pauses, or has ended."""
        return None if self._ended or not self._playing else self._speed

    def step_ns(self, passed_s: float) -> int:
        """Return by how much it can advance: it waits where decoding is behind."""
        wanted_ns = round(passed_s * self._speed * 1e9)
        if self._jumped:
            return 0
        return wanted_ns if self.recorded.complete else min(wanted_ns, max(0, self.recorded.decoded_ns - self._t_ns))

    def advance(self, step_ns: int) -> None:
        """Go on by a time if it plays, and send what came meanwhile."""
        there_ns = self.recorded.decoded_ns
        if self._playing and not self._jumped:
            self._t_ns = max(self._t_ns, min(self._t_ns + step_ns, there_ns))
        if self._ended:
            self._playing = False
        if self._jumped and (self._t_ns <= there_ns or self.recorded.complete):
            self._jumped = False
            self._send_newest()
        elif not self._jumped:
            self._send_passed()

    def report(self, now_s: float) -> None:
        """Send the position, if it has changed, a few times a second."""
        position = text_frame("position", self._position())
        if position != self._reported and now_s - self._reported_s >= POSITION_S:
            self._outgoing.put_newest(f"position/{self._source}", position)
            self._reported_s, self._reported = now_s, position

    @property
    def _ended(self) -> bool:
        return self.recorded.complete and self._t_ns >= self.recorded.end_ns

    def _send_newest(self) -> None:
        """Send the newest message of each topic but events."""
        for path, track in self.recorded.tracks.items():
            end = self._sent[path] = track.up_to(self._t_ns)
            if end > 0 and (TOPICS[path].retained or TOPICS[path].qos == 0):
                self._send(path, end - 1)

    def _send_passed(self) -> None:
        """Send what came since the last turn; of each stream the newest."""
        for path, track in self.recorded.tracks.items():
            first, end = self._sent[path], track.up_to(self._t_ns)
            self._sent[path] = end
            for number in range(first if TOPICS[path].qos else max(first, end - 1), end):
                self._send(path, number)

    def _send(self, path: str, number: int) -> None:
        source, plate = self._source, self.recorded.plate
        if TOPICS[path].qos == 0 and not self._watches(source, plate, path):
            return
        message = payload_frame(source, plate, path, self.recorded.read(path, number))
        if message is None:
            return
        if TOPICS[path].qos:
            self._outgoing.put(message)
        else:
            self._outgoing.put_newest(f"{source}/{plate}/{path}", message)

    def _position(self) -> dict[str, Any]:
        return {
            "source": self._source,
            "t_s": round(self._t_ns * 1e-9, 3),
            "playing": self._playing,
            "speed": self._speed,
            "ended": self._ended,
            "decoded_s": round(self.recorded.decoded_ns * 1e-9, 3),
            "truncated": self.recorded.truncated,
        }


async def play(players: Callable[[], Collection[Player]]) -> None:
    """Play recordings until cancelled; those at the same speed keep their distance in time where decoding is behind."""
    loop = asyncio.get_running_loop()
    before_s = loop.time()
    while True:
        await asyncio.sleep(TURN_S)
        now_s = loop.time()
        steps_ns: dict[float, int] = {}
        for player in players():
            if (speed := player.speed) is not None:
                steps_ns[speed] = min(steps_ns.get(speed, 1 << 62), player.step_ns(now_s - before_s))
        for player in players():
            player.advance(steps_ns.get(player.speed or 0.0, 0))
            player.report(now_s)
        before_s = now_s
