"""A plate's score in the making: hand-made truth, and messages as they come."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from example_messages import example, header
from numpy.typing import NDArray

from resonator_daemon.mqtt import payloads, topics
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.topics import Topic
from resonator_daemon.tools.demo.score import Accuracy, PlateScore
from resonator_daemon.tools.demo.truth import TruthTable

T0_NS = 1_789_000_000_000_000_000
MS = 1_000_000
FRAME_NS = MS
TICKS = 1000  # in a gate
PITCH_M = 4e-4
HEADER = header(seq=0, t_ns=T0_NS)
FAR_NS = T0_NS + 10**12


def frame_end_ns(number: int) -> int:
    return T0_NS + number * FRAME_NS


def touch(
    f_z: float,
    *,
    id: int = 1,
    site: int | None = 7,
    shear: tuple[float, float] = (0.0, 0.0),
    position_m: tuple[float, float] = (0.0, 0.0),
) -> dict[str, Any]:
    return {"id": id, "site": site, "position_m": position_m, "force_newton": [*shear, f_z], "radius_m": None}


SITES_M = np.array([[0.0, 0.0], [1.5e-3, 0.0], [0.0, -2.0e-3], [4e-3, 4e-3]])


class Run:
    """A plate's truth file and score."""

    def __init__(self, path: Path, *, touched_anywhere: bool = False) -> None:
        self._path = path
        self._truth = TruthTable(path)
        self.score = PlateScore(self._truth, 1000.0, SITES_M, touched_anywhere=touched_anywhere)
        self.frames = 0

    def truth(self, *contacts: dict[str, Any]) -> int:
        """Write the truth of the next frame; return the frame's number."""
        self.write(self.line(self.frames, *contacts))
        self.frames += 1
        return self.frames - 1

    @staticmethod
    def line(number: int, *contacts: dict[str, Any]) -> str:
        line = {
            "sequence": number,
            "board_ticks": TICKS * (number + 1),
            "t_ns": str(frame_end_ns(number)),
            "contacts": list(contacts),
            "plate_kelvin": 298.4,
        }
        return json.dumps(line) + "\n"

    def write(self, text: str) -> None:
        with self._path.open("a") as file:
            file.write(text)

    def ramp(self, *f_z: float, **touched: Any) -> None:
        for newton in f_z:
            self.truth(touch(newton, **touched))

    def take(self, topic: Topic[Any], message: payloads.Message, arrived_ns: int = FAR_NS) -> None:
        self.score.add(topic.path, encode(message), arrived_ns)

    def health(
        self, frames: int, *, parts: int = 0, not_decoded: int = 0, arrived_ns: int = FAR_NS, **lost: int
    ) -> None:
        counted = {
            "frames": frames,
            "lost": payloads.Lost(**lost).model_dump(),
            "parts_lost": parts,
            "frames_not_decoded": not_decoded,
        }
        self.score.add("health", json.dumps(counted).encode(), arrived_ns)  # of the rest nothing is read

    def begin(self, frames: int = 0, *, at_ns: int = T0_NS, **counted: int) -> None:
        """Begin with the next `health`, and pass it."""
        self.score.begin()
        self.health(frames, arrived_ns=at_ns, **counted)

    def onset(self, t_ns: int, site: int = 7, event: Any = "onset", arrived_ns: int | None = None) -> None:
        """Pass an event of that time, which arrives at once unless another time is given."""
        contact = example(payloads.ContactEvent).contact.model_copy(update={"site": site})
        message = example(payloads.ContactEvent, **HEADER | {"t_ns": t_ns}, event=event, contact=contact)
        self.take(topics.CONTACT_EVENT, message, t_ns if arrived_ns is None else arrived_ns)

    def forces(
        self, number: int, *sites: tuple[int, float], frames: int = 2, arrived_ns: int = FAR_NS, seq: int = 0
    ) -> None:
        """Pass the message of the window of so many frames whose last gate was frame `number`."""
        forces = tuple(example(payloads.SiteForce, site=site, force_newton=newton) for site, newton in sites)
        ticks, window_s = TICKS * (number + 1), frames * FRAME_NS * 1e-9
        message = example(payloads.Forces, **HEADER | {"seq": seq}, board_ticks=ticks, window_s=window_s, sites=forces)
        self.take(topics.FORCES, message, arrived_ns)

    def decoded(
        self,
        number: int,
        traction_pascal: NDArray[np.float64],
        *,
        grid: bool = True,
        arrived_ns: int = FAR_NS,
        seq: int = 0,
    ) -> None:
        message = payloads.Decoded(
            **HEADER | {"seq": seq},
            board_ticks=TICKS * (number + 1),
            traction_pascal=traction_pascal,
            traction_std_pascal=np.zeros_like(traction_pascal),
            displacement_m=None,
            grid=payloads.Grid(origin_m=(0.0, 0.0), pitch_m=PITCH_M) if grid else None,
        )
        self.take(topics.DECODED, message, arrived_ns)

    def contacts(self, number: int, *contacts: tuple[tuple[float, float], float]) -> None:
        """Pass the contacts of frame `number`: positions and normal forces."""
        reported = tuple(
            example(payloads.Contact, id=id, position_m=position_m, force_newton=(0.3, 0.0, newton))
            for id, (position_m, newton) in enumerate(contacts, 1)
        )
        message = example(payloads.Contacts, **HEADER, board_ticks=TICKS * (number + 1), contacts=reported)
        self.take(topics.CONTACTS, message)

    def result(self, until_ns: int = FAR_NS) -> Accuracy:
        self.score.join()
        return self.score.accuracy(until_ns)

    def found(self, until_ns: int = FAR_NS) -> tuple[int, int, int]:
        """Touches, those found, those of them that were late."""
        result = self.result(until_ns)
        return result.touches, result.found, len(result.late_ms)

    def close(self) -> None:
        self._truth.close()
