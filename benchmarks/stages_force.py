"""Stages from bytes to forces, for `stages.py`: framing, frequency estimation, identification, force path."""

import itertools
import os
from collections.abc import Iterator
from dataclasses import replace
from zlib import crc32

import numpy as np
from cobs import cobs
from matching import COMMON_MODE_STD, LARGEST_NEWTON, OSCILLATOR_STD, ladder
from plate_bench import PlateBench
from scipy.spatial import cKDTree
from stage_measure import Growth, Stage, Work

from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import CHANNEL_COUNT, SINGLE_TONE_STRUCT, TONE_STRUCT
from firmware_protocol.messages import CounterKind, Description, Identity
from firmware_protocol.packets import PacketDecoder
from resonator_daemon.forces.force_sites import ForceSites
from resonator_daemon.forces.force_tones import ForceTones
from resonator_daemon.forces.site_identification import Matcher
from resonator_daemon.plate import load_plate
from resonator_daemon.sensors.multitone_processing import MultitoneProcessing
from resonator_daemon.sensors.plate_sites import force_sites
from resonator_daemon.sensors.single_tone_processing import SingleToneProcessing
from resonator_daemon.tones.tone_detector import capture_band_hz
from resonator_daemon.tones.tone_windows import ToneWindows
from simulators.scenario_file import Touch

SITES = (16, 64, 256, 1024)
STEP = 5  # frames that the daemon takes at once
SETTLED, USED = 200, 400  # frames of the scene
STAMPS = 1000  # of a window of 10 ms, one each 10 µs


def board(kind: CounterKind, tones: int) -> DeviceSession:
    return DeviceSession(Identity("bench", "0", "0", 0), Description(kind, CHANNEL_COUNT, tones, 1, 1, 9, ""), 1)


def framing() -> Stage:
    """Compare reads of five frames of quartz16; bytes of the peer are stuffed, so that a zero ends a packet."""
    session, size = board(CounterKind.SINGLE_TONE, 1), CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
    packets = [session.frame(number, number, os.urandom(size)) for number in range(40 * STEP)]
    steps = [packets[at : at + STEP] for at in range(0, len(packets), STEP)]
    reads = [b"".join(step) for step in steps]
    stuffed = [b"".join(cobs.encode(packet) + b"\0" for packet in step) for step in steps]
    decoder = PacketDecoder(from_board=True)

    def peer() -> None:
        for read in stuffed:
            for packet in read.split(b"\0")[:-1]:
                crc32(cobs.decode(packet))

    return Stage(
        "framing",
        Work("", lambda: [decoder.feed(read) for read in reads], len(packets)),
        Work("cobs and zlib.crc32", peer, len(packets)),
        Work("zlib.crc32 of each frame", lambda: [crc32(packet) for packet in packets], len(packets)),
    )


class QuartzFrames:
    """Frames of quartz16 with one touch, again and again: sequence numbers and ticks run on."""

    def __init__(self) -> None:
        self.plate = load_plate("quartz16")
        bench = PlateBench(self.plate, [Touch(start_s=0.15, site=4, force_newton=2.0, rise_s=0.01, hold_s=1e6)])
        counted = [b"".join(frame.channels) for frame in bench.count((SETTLED + USED) * 1e-3)]
        self.settling, self.payloads = counted[:SETTLED], counted[SETTLED:]
        self.gate_ticks = round(self.plate.counter.reference_hz / self.plate.counter.frame_rate_hz)

    @property
    def steps(self) -> list[bytes]:
        return [b"".join(self.payloads[at : at + STEP]) for at in range(0, len(self.payloads), STEP)]


def numbers_of(steps: list[bytes]) -> Work:
    """Return the work that any Python program does with records."""

    def run() -> None:
        for payload in steps:
            [record[4] / record[2] for record in SINGLE_TONE_STRUCT.iter_unpack(payload)]

    return Work("struct.unpack and one division for each record", run, len(steps) * STEP)


def frequency_estimation(frames: QuartzFrames) -> Stage:
    """Compare estimates from records of four channels over 10 ms, one each 5 ms."""
    plate, steps = frames.plate, frames.steps
    reference_hz = plate.counter.reference_hz
    windows = ToneWindows(CHANNEL_COUNT, 10, reference_hz, capture_band_hz(plate.pilot_hz, plate.tones.f0_hz))
    samples = np.random.default_rng(0).standard_normal((CHANNEL_COUNT, STAMPS))

    def ours() -> None:
        windows.restart()
        for payload in steps:
            block = windows.push(payload)
            block.windows([STEP - 1], [min(10, block.held[STEP - 1][0])]).frequency_hz(0)

    def peer() -> None:
        for _ in steps:
            power = np.abs(np.fft.rfft(samples)) ** 2
            peak = np.clip(power.argmax(axis=1), 1, power.shape[1] - 2)
            rows = np.arange(CHANNEL_COUNT)
            left, top, right = (np.log(power[rows, peak + off]) for off in (-1, 0, 1))
            peak + 0.5 * (left - right) / (left - 2.0 * top + right)

    return Stage(
        "frequency estimation",
        Work("", ours, len(steps) * STEP),
        Work("numpy.fft.rfft of 4 x 1000 samples and a parabola, each 5 frames", peer, len(steps) * STEP),
        numbers_of(steps),
    )


def identify(sites: int) -> Work:
    codes = ladder(400e-6, sites)
    matcher = Matcher(*codes, LARGEST_NEWTON)
    measured_hz = codes.f0_hz[5] / (1 - codes.sensitivity[5] * 2.0)
    stds = np.full(4, 5e-10)
    return Work("", lambda: matcher.match(measured_hz, stds, OSCILLATOR_STD, COMMON_MODE_STD))


def identification() -> Stage:
    """Four frequencies to site and force, among 16 sites; the daemon does it each 5 frames."""
    codes = ladder(400e-6, 16)
    measured_hz = np.asarray(codes.f0_hz[5] / (1 - codes.sensitivity[5] * 2.0))
    tree = cKDTree(codes.f0_hz)
    return Stage(
        "identification",
        identify(16),
        Work("scipy cKDTree, nearest code without force and error", lambda: tree.query(measured_hz)),
        Work("numpy, relative shift against each code", lambda: measured_hz / codes.f0_hz - 1.0),
    )


def force_path(frames: QuartzFrames) -> Stage:
    """Compare records of quartz16 to readings with contacts, five frames at once."""
    plate, steps = frames.plate, frames.steps
    single = _single_tone(frames, force_sites(plate))
    f0_hz, sensitivity, reference_hz = plate.tones.f0_hz, plate.tones.sensitivity, plate.counter.reference_hz
    baseline = np.zeros(CHANNEL_COUNT)

    def peer() -> None:
        for payload in steps:
            records = np.array(list(SINGLE_TONE_STRUCT.iter_unpack(payload)), np.float64)
            stamps, stride, span = records[:, 2], records[:, 3], records[:, 4]
            found_hz = ((stamps - 1.0) * stride * reference_hz / span).reshape(STEP, CHANNEL_COUNT).mean(axis=0)
            shifts = found_hz / f0_hz - 1.0 - baseline
            site = int((shifts**2).sum(axis=1).argmin())
            float((shifts[site] / sensitivity[site]).mean())
            baseline[:] += 1e-6 * shifts[site]

    return Stage(
        "force path",
        single,
        Work("numpy: mean, moving baseline, nearest code; no contacts, errors and checks", peer, len(steps) * STEP),
        numbers_of(steps),
    )


def _single_tone(frames: QuartzFrames, sites: ForceSites) -> Work:
    plate, steps = frames.plate, frames.steps
    processing = SingleToneProcessing(
        sites,
        pilot_hz=plate.pilot_hz,
        reference_hz=plate.counter.reference_hz,
        gate_s=1 / plate.counter.frame_rate_hz,
        window_frames=10,
        step_frames=STEP,
    )
    number = itertools.count(0, STEP)

    def push(payload: bytes) -> None:
        first = next(number)
        processing.push(first, [frames.gate_ticks * (first + each) for each in range(1, STEP + 1)], payload)

    for at in range(0, SETTLED, STEP):
        push(b"".join(frames.settling[at : at + STEP]))

    def run() -> None:
        for payload in steps:
            push(payload)

    return Work("", run, len(steps) * STEP)


def frames_of(tones: int) -> Work:
    """Framing of channelised frames, whose size grows with the number of tones."""
    session = board(CounterKind.CHANNELISED, tones)
    channels = [os.urandom(tones * TONE_STRUCT.size) for _ in range(CHANNEL_COUNT)]
    reads = [b"".join(session.frame_parts(number, number, channels)) for number in range(8)]
    decoder = PacketDecoder(from_board=True)
    return Work("", lambda: [decoder.feed(read) for read in reads], len(reads))


def more_sites(sites: ForceSites, count: int) -> ForceSites:
    """Return sites with codes and places of others: those of a square grid, and of a ladder."""
    side = int(np.ceil(np.sqrt(count)))
    axis_m = np.linspace(-9e-3, 9e-3, side)
    places_m = np.stack(np.meshgrid(axis_m, axis_m), axis=-1).reshape(-1, 2)[:count]
    codes, warmth = ladder(400e-6, count), sites.warmth
    repeated = replace(
        warmth,
        coefficients=np.resize(warmth.coefficients, (count, 3)),
        contact_std_kelvin=np.resize(warmth.contact_std_kelvin, count),
    )
    return replace(
        sites, f0_hz=codes.f0_hz, sensitivity=codes.sensitivity, positions_m=places_m, warmth=repeated, response=None
    )


def multitone(count: int) -> Work:
    """Frames of a counter of all tones of force sites, to readings; nothing is touched."""
    plate = load_plate("comb16")
    sites = more_sites(force_sites(plate), count)
    oscillators_hz = np.ascontiguousarray(sites.f0_hz.T)
    tones = ForceTones(sites.f0_hz, sites.sensitivity, oscillators_hz, np.arange(count), np.zeros(count, np.intp))
    processing = MultitoneProcessing(
        sites, tones, reference_hz=plate.counter.reference_hz, gate_s=0.005, window_frames=2, step_frames=1
    )
    rng, number = np.random.default_rng(0), itertools.count()
    shape = (CHANNEL_COUNT, count)
    phase, offset = np.zeros(shape, np.uint32), rng.integers(-3, 3, shape).astype(np.int32)
    sigma, known = np.full(shape, 20, np.uint8), np.ones(shape, bool)
    ticks = round(0.005 * plate.counter.reference_hz)

    def run() -> None:
        at = next(number)
        processing.push(at, (at + 1) * ticks, phase, offset, sigma, known)

    return Work("", run)


def stages() -> Iterator[Stage]:
    yield framing()
    frames = QuartzFrames()
    yield frequency_estimation(frames)
    yield identification()
    yield force_path(frames)


def growths() -> Iterator[Growth]:
    yield Growth("framing", "sites", SITES, lambda sites: frames_of(3 * sites))
    yield Growth("identification", "sites", SITES, identify)
    yield Growth("force path, all tones counted", "sites", SITES, multitone)
