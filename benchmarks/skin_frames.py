"""Frames of a skin, one after the other, as work that can be pickled."""

from dataclasses import dataclass

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.fitting.contact_start import ContactStart
from resonator_daemon.decoding.fitting.slip import SlipWatch


@dataclass
class ContactFrames:
    """Map with contact physics, frame after frame; matrices of a moved contact are made at once."""

    decoder: ContactDecoder
    frames: list[Floats]

    def __call__(self) -> None:
        for frame in self.frames:
            self.decoder.decode(frame)
            self.decoder.rebuild()


@dataclass
class SlipFrames:
    """Fit of one contact, frame after frame."""

    watch: SlipWatch
    frames: list[Floats]
    noise_std: Floats
    start: dict[int, ContactStart]

    def __call__(self) -> None:
        for frame in self.frames:
            self.watch.update(frame, self.noise_std, self.start)
