"""How right the decoders of a skin are, and what a frame and a set-up cost.

`decoding.py errors` prints errors of maps and contacts by scene and noise, and how much the stated uncertainty covers;
`decoding.py model` what is covered or contradicted on a skin that is not as its plate file;
`decoding.py frame` the processor time of a whole frame of skin32 by scene, as the daemon decodes it; `decoding.py
set-up` the time to set up decoders. Signals are closed-form, decibels are those of 1 N, and BLAS has one thread.
PYTHONPATH=DIR measures another checkout.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import load_plate
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.decoder_setup import set_up
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder
from resonator_daemon.measure.sensors.surface_requests import stated_skin
from simulators.contact import hertz_parts, pixel_tractions, punch_parts
from simulators.half_space_fields import hertz_fields
from simulators.pressed_surface import PressedSurface

YOUNGS_PASCAL, NU, DEPTH_M, PITCH_M = 2e5, 0.5, 1e-3, 4e-4
RADIUS_M, FRICTION = 2.5e-3, 0.5  # of contact at 1 N
BODY = HalfSpace(YOUNGS_PASCAL, NU)
SIDE, BIG = 32, 64
LEVELS_DB = (11, 20, 30, 40)
GAIN_ERROR, FRAME_DB = 0.01, 30.0  # of the frames whose time is measured
WARM_UP = 10  # frames, in which contacts begin and matrices are built
TO_TRIPLE = np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])


class Load(NamedTuple):
    """A contact in one frame."""

    centre_m: tuple[float, float]
    force_newton: tuple[float, float, float]


def grid(side: int = SIDE) -> Floats:
    axis_m = (np.arange(side) - (side - 1) / 2) * PITCH_M
    return np.stack(np.meshgrid(axis_m, axis_m), axis=-1).reshape(-1, 2)


SITES_M = grid()


def signals(loads: list[Load]) -> Floats:
    """Return the signals (3, n) of contacts, without noise."""
    total = np.zeros((3, len(SITES_M)))
    for load in loads:
        radii, forces = hertz_parts(load.force_newton, RADIUS_M, FRICTION)
        fields = hertz_fields(SITES_M - load.centre_m, DEPTH_M, radii, YOUNGS_PASCAL, NU)
        total += np.einsum("kf,kfsn->sn", forces, fields)
    return np.asarray(total * TO_TRIPLE, np.float64)


def traction(loads: list[Load]) -> Floats:
    """Return the traction (3, pixels) of contacts on the grid of skin32."""
    parts = [
        pixel_tractions(each.force_newton, each.centre_m, RADIUS_M, FRICTION, (SIDE,) * 2, PITCH_M) for each in loads
    ]
    return np.asarray(np.sum(parts, axis=0).reshape(3, -1))


def noise_at(decibel: float) -> float:
    rms = np.sqrt(np.mean(signals([Load((0.0, 0.0), (0.0, 0.0, 1.0))]) ** 2))
    return float(rms * 10.0 ** (-decibel / 20.0))


# Errors.


def random_load(rng: np.random.Generator) -> Load:
    x, y = rng.uniform(-3e-3, 3e-3, 2)
    normal, share, angle = rng.uniform([0.3, 0.1, 0.0], [1.5, 0.9, 2.0 * np.pi])
    shear = share * FRICTION * normal
    return Load((x, y), (shear * np.cos(angle), shear * np.sin(angle), normal))


EDGE_M = SIDE * PITCH_M / 2
SHEARED = (0.4, 0.0, 1.0)
ERROR_SCENES: dict[str, Callable[[np.random.Generator], list[Load]]] = {
    "centred": lambda _: [Load((0.0, 0.0), SHEARED)],
    "border": lambda _: [Load((EDGE_M - 0.9e-3, 0.0), SHEARED)],
    "outside": lambda _: [Load((EDGE_M + 1.6e-3, 0.0), SHEARED)],
    "two": lambda _: [Load((-3e-3, 0.0), SHEARED), Load((3e-3, 1e-3), (0.0, 0.1, 0.5))],
    "random": lambda rng: [random_load(rng)],
}


def maps(noise: float) -> dict[str, Callable[[Floats], tuple[Floats, Floats]]]:
    """Return decoders of frames (3, n) to traction and its standard deviation."""
    linear = OpenPlaneDecoder(BODY, SITES_M, DEPTH_M, noise)
    fourier = FourierDecoder(BODY, (SIDE, SIDE), PITCH_M, DEPTH_M, noise)
    found: dict[str, Callable[[Floats], tuple[Floats, Floats]]] = {}
    for name, decoder, shape in (
        ("open-plane", linear, (3, -1)),
        ("Fourier", fourier, (3, SIDE, SIDE)),
        ("contact physics", ContactDecoder(linear), (3, -1)),
        ("contact physics, mu given", ContactDecoder(linear, FRICTION), (3, -1)),
    ):

        def decode(frame: Floats, decoder=decoder, shape=shape) -> tuple[Floats, Floats]:  # type: ignore[no-untyped-def]
            if isinstance(decoder, ContactDecoder):
                decoder.reset()
            decoded = decoder.decode(frame.reshape(shape))
            return decoded.traction_pascal.reshape(3, -1), decoded.traction_std_pascal.reshape(3, -1)

        found[name] = decode
    return found


def print_map_errors(draws: int) -> None:
    columns = "".join(f"{f'{level} dB':>16}" for level in LEVELS_DB)
    print(
        f"relative L2 error of the traction; share of f_z in the contact within 2 standard deviations\n{'':36}{columns}"
    )
    by_level = [maps(noise_at(level)) for level in LEVELS_DB]
    for name in by_level[0]:
        for scene, make in ERROR_SCENES.items():
            cells = []
            for level, decoders in zip(LEVELS_DB, by_level, strict=True):
                rng, rows = np.random.default_rng(1), []
                for _ in range(draws):
                    loads = make(rng)
                    truth = traction(loads)
                    frame = signals(loads) + noise_at(level) * rng.standard_normal((3, SIDE * SIDE))
                    found, std = decoders[name](frame)
                    pressed = truth[2] > 1e-9 * truth[2].max()
                    within = np.abs(found - truth)[2] < 2.0 * std[2]
                    rows.append((np.linalg.norm(found - truth) / np.linalg.norm(truth), np.mean(within[pressed])))
                error, covered = np.nanmean(rows, axis=0)
                cells.append(f"{error:9.3f} {covered:6.1%}")
            print(f"{name:26}{scene:10}{''.join(cells)}", flush=True)


def print_contact_errors(draws: int) -> None:
    print("\ncontacts: rms errors of F_t, F_z in mN, of the place in mm, of the slip margin; share within 2 deviations")
    for level in LEVELS_DB[1:]:
        noise_std = np.full((3, SIDE * SIDE), noise_at(level))
        decoder = SkinDecoder(Skin(BODY, SITES_M, DEPTH_M), DecodingOptions(), noise_std, lambda _: None)
        rng, errors, scores, missed = np.random.default_rng(2), [], [], 0
        for _ in range(draws):
            load = random_load(rng)
            decoder.start_cold()
            for _ in range(4):  # a contact begins in the second frame, its matrices are there in the third
                frame = signals([load]) + noise_std * rng.standard_normal(noise_std.shape)
                reading = decoder.decode(frame, noise_std)
            if len(reading.contacts) != 1:
                missed += 1
                continue
            patch, slip = reading.contacts[0].patch, reading.contacts[0].slip
            margin = 1.0 - float(np.hypot(*load.force_newton[:2])) / (FRICTION * load.force_newton[2])
            off = np.array([*(patch.force_newton - load.force_newton), *(patch.centroid_m - load.centre_m)])
            std = np.array([*patch.force_std_newton, *patch.centroid_std_m])
            told = slip is not None and slip.slip_margin is not None
            last = (slip.slip_margin - margin, slip.slip_margin_std) if told else (np.nan, np.nan)
            errors.append([*off, last[0]])
            scores.append(np.abs([*(off / std), last[0] / last[1]]))
        rms = 1e3 * np.sqrt(np.nanmean(np.square(errors), axis=0))
        within = np.sum(np.nan_to_num(scores, nan=9.0) < 2.0, axis=0) / np.isfinite(scores).sum(axis=0)
        figures = f"{rms[:2].mean():.2f} {rms[2]:.2f} mN, {rms[3:5].mean():.4f} mm, {1e-3 * rms[5]:.3f}; "
        figures += f"{within[:2].mean():.1%} {within[2]:.1%} {within[3:5].mean():.1%} {within[5]:.1%}"
        print(f"{level} dB: {figures}, {missed} of {draws} missed", flush=True)


# What is stated while the model is wrong.


class ModelError(NamedTuple):
    """A skin that is not as stated: factors, and errors of the sites' places and of the signals."""

    depth: float = 1.0
    modulus: float = 1.0
    poisson: float = NU
    gain: float = 1.0
    positions_m: float = 0.0
    common: float = 0.0  # of the noise, in all signals
    walk: float = 0.0  # of the noise, a frame
    site: float = 1.0  # factor of the signals of the site next to the contact
    second: float = 0.0  # share of the force that acts 4 mm away
    layer: float = np.inf  # thickness of the skin on a rigid plate, in depths
    adhesion: float = 0.0  # share of the load
    flat: bool = False  # a punch and no ball

    def surface(self) -> PressedSurface:
        sites_m = SITES_M + self.positions_m * np.random.default_rng(2).standard_normal(SITES_M.shape)
        body = self.depth * DEPTH_M, self.modulus * YOUNGS_PASCAL, self.poisson
        punch = (1.0, 1.0) if self.flat else (0.0, -self.adhesion)
        return PressedSurface(sites_m, *body, 30e-3, 5e-3, punch=punch, thickness_m=self.layer * DEPTH_M)

    def signals(
        self, surface: PressedSurface, load: Load, noise: float, frame: int, rng: np.random.Generator
    ) -> Floats:
        x, y = load.centre_m
        centres_m = (load.centre_m, (x - 4e-3 if x > 0.0 else x + 4e-3, y))
        total = np.zeros((3, len(SITES_M)))
        for centre_m, share in zip(centres_m, (1.0, self.second), strict=True):
            force_newton = share * np.array([load.force_newton])
            loads = (punch_parts if self.flat else hertz_parts)(force_newton, RADIUS_M, FRICTION)
            total += surface.signals(centre_m, *loads)[0] * TO_TRIPLE
        total[:, np.hypot(*(SITES_M - load.centre_m).T).argmin()] *= self.site
        common = noise * (self.common * (frame > REST) + self.walk * frame)
        return np.asarray(self.gain * total + common + noise * rng.standard_normal(total.shape))


REST, PRESSED = 40, 30  # frames
MODEL_ERRORS = {
    "none": ModelError(),
    "depth +5 %": ModelError(depth=1.05),
    "depth -5 %": ModelError(depth=0.95),
    "modulus +5 %": ModelError(modulus=1.05),
    "modulus -5 %": ModelError(modulus=0.95),
    "Poisson's ratio .45": ModelError(poisson=0.45),
    "all gains +5 %": ModelError(gain=1.05),
    "sites off by .1 mm": ModelError(positions_m=1e-4),
    "common mode .3": ModelError(common=0.3),
    "common mode 1": ModelError(common=1.0),
    "common walk .05 a frame": ModelError(walk=0.05),
    "a dead site": ModelError(site=0.0),
    "a site +20 %": ModelError(site=1.2),
    "a second contact": ModelError(second=0.3),
    "layer of 10 depths": ModelError(layer=10.0),
    "adhesion .1": ModelError(adhesion=0.1),
    "adhesion .3": ModelError(adhesion=0.3),
    "flat punch": ModelError(flat=True),
}


def print_model_errors(draws: int) -> None:
    """Print what contacts of the shipped skin32 state, with its own standard deviations, noise and systematic ones."""
    print(
        "30 dB; share within 2 deviations of place, force, slip margin; frames contradicted, runs with a suspect site"
    )
    noise = noise_at(30.0)
    noise_std, skin = np.full((3, len(SITES_M)), noise), shipped("skin32")
    for name, off in MODEL_ERRORS.items():
        rng, scores, contradicted, suspects = np.random.default_rng(3), [], [], 0
        surface = off.surface()
        for _ in range(draws):
            load = random_load(rng)
            decoder = SkinDecoder(skin, DecodingOptions(), noise_std, lambda _: None)
            margin = 1.0 - float(np.hypot(*load.force_newton[:2])) / (FRICTION * load.force_newton[2])
            for frame in range(REST + PRESSED):
                pressed = load if frame > REST else Load(load.centre_m, (0.0, 0.0, 0.0))
                reading = decoder.decode(off.signals(surface, pressed, noise, frame, rng), noise_std)
                if frame in (REST + 15, REST + 22, REST + 29):
                    decoder.check()
                if frame < REST + 10 or not reading.contacts:
                    continue
                contact = max(reading.contacts, key=lambda each: each.patch.force_newton[2])
                patch, slip, systematic = contact.patch, contact.slip, contact.systematic
                has_margin = slip is not None and slip.slip_margin is not None
                error = [*(patch.centroid_m - load.centre_m), *(patch.force_newton - load.force_newton)]
                error.append(slip.slip_margin - margin if has_margin else np.nan)
                std = [*patch.centroid_std_m, *patch.force_std_newton, slip.slip_margin_std if has_margin else np.nan]
                shared = [*systematic.position_m, *systematic.force_newton, systematic.slip_margin]
                scores.append(np.abs(np.array(error) / np.hypot(std, shared)))
                contradicted.append(contact.status == "contradicted")
            suspects += bool(decoder.suspects)
        if not scores:
            print(f"{name:26} no contact was fitted", flush=True)
            continue
        within = np.sum(np.nan_to_num(scores, nan=9.0) < 2.0, axis=0) / np.isfinite(scores).sum(axis=0)
        shares = f"{within[:2].mean():7.0%} {within[2:5].mean():7.0%} {within[5]:7.0%}"
        print(f"{name:26}{shares}; {np.mean(contradicted):7.0%} {suspects:5} of {draws}", flush=True)


# Cost of a frame.

Path_ = Callable[[int], list[Load]]  # frame number to the contacts of the frame


class Scene(NamedTuple):
    """What happens on the skin."""

    loads: Path_
    friction_coefficient: float | None = None  # that the decoder is given


def swing(frame: int, step_m: float, reach_m: float) -> float:
    """Coordinate of a point that goes back and forth by a step each frame."""
    phase = (frame * step_m) % (4.0 * reach_m)
    return phase - reach_m if phase < 2.0 * reach_m else 3.0 * reach_m - phase


def sheared(frame: int, share: float = 0.6, newton: float = 1.0, angle: float = 0.6) -> tuple[float, float, float]:
    """Force whose shear varies slowly by a third about a share of the largest that friction bears."""
    shear = FRICTION * newton * share * (1.0 + np.sin(frame / 15.0) / 3.0)
    return shear * np.cos(angle), shear * np.sin(angle), newton


def moving(step_m: float) -> Path_:
    return lambda frame: [Load((swing(frame, step_m, 3e-3), 0.4e-3), sheared(frame))]


def two(frame: int) -> list[Load]:
    aside_m = swing(frame, 1e-5, 1e-3)
    first, second = sheared(frame, newton=0.5), sheared(frame, 0.4, 0.4, 1.0)
    return [Load((-3e-3 + aside_m, -1e-3), first), Load((3e-3, 1.5e-3 + aside_m), second)]


SLIDING = "sheared, sliding .03 mm a frame"
SCENES: dict[str, Scene] = {
    "nothing": Scene(lambda _: []),
    SLIDING: Scene(moving(3e-5)),
    "sheared, sliding, mu given": Scene(moving(3e-5), FRICTION),
    "sheared, at rest": Scene(lambda _: [Load((0.7e-3, 0.4e-3), sheared(0))]),
    "pressed, no shear": Scene(lambda _: [Load((0.7e-3, 0.4e-3), (0.0, 0.0, 1.0))]),
    "two contacts": Scene(two),
    "moving .16 mm a frame": Scene(moving(1.6e-4)),
}


def frame_ms(scene: Scene, frames: int) -> tuple[Floats, int]:
    """Return thread time of map, contacts and rebuilds of each frame (frames, 3) in ms, and how many rebuilds."""
    rng = np.random.default_rng(0)
    noise_std = np.full((3, len(SITES_M)), noise_at(FRAME_DB))
    gains = 1.0 + GAIN_ERROR * rng.standard_normal(noise_std.shape)
    options = DecodingOptions(friction_coefficient=scene.friction_coefficient)
    decoder = SkinDecoder(Skin(BODY, SITES_M, DEPTH_M), options, noise_std, lambda _: None)
    spent_ms, rebuilds = np.zeros((frames, 3)), 0
    for number in range(-WARM_UP, frames):
        frame = signals(scene.loads(number)) * gains + noise_std * rng.standard_normal(noise_std.shape)
        marks = [time.thread_time()]
        decoded = decoder.decode_map(frame, noise_std)
        marks.append(time.thread_time())
        decoder.read_contacts(decoded)
        marks.append(time.thread_time())
        rebuilds += decoder.rebuild() and number >= 0
        marks.append(time.thread_time())
        if number >= 0:
            spent_ms[number] = 1e3 * np.diff(marks)
    return spent_ms, rebuilds


def print_frame_costs(frames: int) -> None:
    print(f"{'ms of thread time':34} median    p95   mean     map  contacts  rebuilds (number)")
    for name, scene in SCENES.items():
        spent_ms, rebuilds = frame_ms(scene, frames)
        total, parts = spent_ms[:, :2].sum(axis=1), spent_ms.mean(axis=0)
        print(
            f"{name:34} {np.median(total):6.2f} {np.percentile(total, 95):6.2f} {parts.sum():6.2f} "
            f"{parts[0]:7.2f} {parts[1]:9.2f} {parts[2]:9.2f} ({rebuilds})",
            flush=True,
        )
    print("median and p95 without rebuilds, mean with them")


# Set-up.


def shipped(name: str) -> Skin:
    plate = load_plate(name)
    return stated_skin(plate.required_skin, plate.site_positions_m)


def print_set_ups(repeats: int) -> None:
    """Print the least time of some repeats; from the cache is hash, reading, checksum and unpickling."""
    print(f"{'seconds of one thread':24} from nothing  from the cache  file, MB")
    skins = {
        "skin32": shipped("skin32"),
        "fingertip400": shipped("fingertip400"),
        "64 x 64": Skin(BODY, grid(BIG), DEPTH_M),
    }
    for name, skin in skins.items():
        noise_std, options = np.full((3, len(skin.site_positions_m)), 1e-4), DecodingOptions()
        with tempfile.TemporaryDirectory() as folder:
            os.environ["CACHE_DIRECTORY"] = folder
            spent: list[list[float]] = [[], []]
            for _ in range(repeats):
                for path in Path(folder).iterdir():
                    path.unlink()
                for times in spent:
                    began = time.thread_time()
                    set_up(skin, options, noise_std, lambda _: None)
                    times.append(time.thread_time() - began)
            size_mb = sum(path.stat().st_size for path in Path(folder).iterdir()) / 1e6
        print(f"{name:24} {min(spent[0]):12.2f} {min(spent[1]):15.3f} {size_mb:9.0f}", flush=True)
    program = "import time; import resonator_daemon.estimate.surface.streaming; print(time.process_time())"
    run = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    print(f"start of Python with the decoders: {float(run.stdout):.2f} s of processor time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=("errors", "model", "frame", "set-up"))
    parser.add_argument("--count", type=int, help="draws (20, of model 10), frames (200), or repeats (3)")
    options = parser.parse_args()
    with threadpool_limits(1):
        if options.figure == "errors":
            print_map_errors(options.count or 20)
            print_contact_errors(options.count or 20)
        elif options.figure == "model":
            print_model_errors(options.count or 10)
        elif options.figure == "frame":
            print_frame_costs(options.count or 200)
        else:
            print_set_ups(options.count or 3)


if __name__ == "__main__":
    main()
