"""Stick radius, contact radius and slip in simulated frames: errors, z-scores, alarms and times.

Run it with `python benchmarks/slip.py [DRAWS [LOADS]]`. Contacts: 32 x 32 sites, 0.4 mm apart and 1 mm
deep, contact radius 2 .. 3 mm, c/a 0.3 .. 0.8, mu 0.5, centre within 2.5 mm; noise of equal variance in all signals.
Truth comes from closed forms in space, the fits from spectra.
"""

import sys
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.contact_start import ContactStart, Friction
from resonator_daemon.decoding.fitting.slip import SlipWatch
from resonator_daemon.decoding.fitting.slip_fitter import fit_partial_slip
from resonator_daemon.decoding.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.decoding.patches import PatchFinder
from resonator_daemon.elastic import HalfSpace
from simulators.contact import pressed_signals

E, NU, DEPTH_M, PITCH_M, MU = 2e5, 0.5, 1e-3, 4e-4, 0.5
RADIUS_MAX_M = 6e-3
RATE_HZ = 200.0
TO_TRIPLE = np.array([[1.5 / E], [1.0], [1.0]])
AXIS = (np.arange(32) - 15.5) * PITCH_M
SITES_M = np.stack(np.meshgrid(AXIS, AXIS), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Scene:
    """A random contact under 1 N."""

    centre_m: tuple[float, float]
    start: ContactStart
    radius_m: float
    mu: float
    along: Floats

    @classmethod
    def draw(cls, rng: np.random.Generator, mu: float) -> "Scene":
        x, y = rng.uniform(-2.5e-3, 2.5e-3, 2)
        radius, angle = rng.uniform(2e-3, 3e-3), rng.uniform(0.0, 2.0 * np.pi)
        off_x, off_y = rng.normal(0.0, 4e-4, 2)
        start = ContactStart((x + off_x, y + off_y), radius * rng.uniform(0.75, 1.3))
        return cls((x, y), start, radius, mu, np.array([np.cos(angle), np.sin(angle)]))

    def signals(self, share: Floats) -> Floats:
        """Frames (t, 3, n) at shares of the largest shear that friction bears."""
        forces = np.column_stack([self.mu * share[:, None] * self.along, np.ones_like(share)])
        skin = (SITES_M, DEPTH_M, E, NU, self.centre_m, self.radius_m, self.mu)
        return np.stack([pressed_signals(*skin, force) * TO_TRIPLE for force in forces])


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def stick_radius(draws: int) -> None:
    models = {
        factor: DiscModel(HalfSpace(factor * E, NU), SITES_M, factor * DEPTH_M, RADIUS_MAX_M)
        for factor in (0.95, 1.0, 1.05)
    }
    cases: dict[str, tuple[Friction | None, bool]] = {
        "mu known": (Friction(MU), False),
        "mu unknown": (None, False),
        "mu within 5 %, depth and E 5 % off": (Friction(MU, 0.05 * MU), True),
        "mu unknown, depth and E 5 % off": (None, True),
    }
    print("dB  case                                  c/a rms     z  a rms %     z  margin rms  unknown  median ms")
    for decibel in (11.0, 20.0, 30.0):
        print(f"{draws} frames for each row at {decibel:.0f} dB", file=sys.stderr)
        for name, (friction, wrong) in cases.items():
            rng = np.random.default_rng(1)
            ratios, ratio_scores, radii, radius_scores, margins, spent_ms = [], [], [], [], [], []
            for draw in range(draws):
                scene, ratio = Scene.draw(rng, MU), rng.uniform(0.3, 0.8)
                frame = scene.signals(np.array([1.0 - ratio**3]))[0]
                noise = float(np.sqrt(np.mean(frame**2))) * 10.0 ** (-decibel / 20.0)
                frame = frame + noise * rng.standard_normal(frame.shape)
                factor = (0.95, 1.05)[draw % 2] if wrong else 1.0
                start = ContactStart(scene.start.centre_m, scene.start.radius_m, friction=friction)
                frame[0] /= factor  # the modulus enters the first signal
                began = time.perf_counter()
                found = fit_partial_slip(models[factor], frame, noise, [start])[0]
                spent_ms.append(1e3 * (time.perf_counter() - began))
                if found.status != "ok":
                    continue
                ratios.append(found.stick_ratio - ratio)
                ratio_scores.append(ratios[-1] / found.stick_ratio_std)
                radii.append(found.radius_m / scene.radius_m - 1.0)
                radius_scores.append((found.radius_m - scene.radius_m) / found.radius_std_m)
                margins.append(found.slip_margin - ratio**3)
            print(
                f"{decibel:2.0f}  {name:36}  {rms(ratios):7.4f} {rms(ratio_scores):5.2f}  {100 * rms(radii):7.3f}"
                f" {rms(radius_scores):5.2f}  {rms(margins):10.4f}  {draws - len(ratios):7}  {np.median(spent_ms):9.1f}"
            )


def net_forces(draws: int) -> None:
    print(
        "\nnet forces of the patch, mu known\ndB  decoder              c/a rms  F_z bias %  sd %  z F_z  z F_t  missed"
    )
    finder = PatchFinder(SITES_M, PITCH_M**2, DEPTH_M)
    for decibel in (11.0, 20.0, 30.0):
        rng = np.random.default_rng(2)
        scenes = [(Scene.draw(rng, MU), rng.uniform(0.3, 0.8)) for _ in range(draws)]
        frames = [scene.signals(np.array([1.0 - ratio**3]))[0] for scene, ratio in scenes]
        noise = float(np.median([np.sqrt(np.mean(frame**2)) for frame in frames])) * 10.0 ** (-decibel / 20.0)
        noisy = [frame + noise * rng.standard_normal(frame.shape) for frame in frames]
        linear = OpenPlaneDecoder(HalfSpace(E, NU), SITES_M, DEPTH_M, noise)
        contact = ContactDecoder(linear)
        for name, decoder in (("open-plane", linear), ("open-plane+contact", contact)):
            ratios, pressures, scores, shear_scores = [], [], [], []
            for (scene, ratio), frame in zip(scenes, noisy, strict=True):
                contact.reset()
                decoded = decoder.decode(frame)
                patches = finder.find(decoded.traction_pascal, decoded.traction_std_pascal)
                if len(patches) != 1:
                    continue
                force, std = patches[0].force_newton, patches[0].force_std_newton
                margin = 1.0 - float(np.hypot(force[0], force[1])) / (MU * float(force[2]))
                ratios.append(max(margin, 0.0) ** (1.0 / 3.0) - ratio)
                pressures.append(100.0 * (force[2] - 1.0))
                scores.append((force[2] - 1.0) / std[2])
                truth = MU * (1.0 - ratio**3) * scene.along
                shear_scores += ((force[:2] - truth) / std[:2]).tolist()
            print(
                f"{decibel:2.0f}  {name:20} {rms(ratios):7.4f}  {np.mean(pressures):10.2f}  {np.std(pressures):4.2f}"
                f"  {rms(scores):5.2f}  {rms(shear_scores):5.2f}  {draws - len(ratios):6}"
            )


def events(loads: int) -> None:
    print("\nevents at 20 dB, 200 frames/s, ramps of 0.2 .. 2 s, mu 0.3 .. 1 never told")
    model = DiscModel(HalfSpace(E, NU), SITES_M, DEPTH_M, RADIUS_MAX_M)
    for safe in (False, True):
        rng = np.random.default_rng(3)
        print(f"{loads} {'safe loads' if safe else 'ramps'}", file=sys.stderr)
        right, unknown, spent_ms, leads, scores = 0, 0, [], [], []
        for _ in range(loads):
            scene, watch = Scene.draw(rng, rng.uniform(0.3, 1.0)), SlipWatch(model)
            duration_s = np.exp(rng.uniform(np.log(0.2), np.log(2.0)))
            ramp = np.linspace(0.0, 0.5 if safe else 1.1, int(duration_s * RATE_HZ))
            hold = 0.5 - rng.uniform(0.0, 0.3) * np.abs(np.sin(np.linspace(0.0, 10.0, 40)))
            share = np.concatenate([ramp, hold]) if safe else ramp
            frames = scene.signals(share)
            noise = 0.1 * float(np.sqrt(np.mean(frames[0] ** 2)))
            announced = len(frames)
            for index, frame in enumerate(frames):
                noisy = frame + noise * rng.standard_normal(frame.shape)
                began = time.perf_counter()
                fits, news = watch.update(noisy, noise, {1: scene.start})
                spent_ms.append(1e3 * (time.perf_counter() - began))
                unknown += fits[1].status != "ok"
                if fits[1].status == "ok":
                    truth = max(1.0 - float(share[index]), 0.0)
                    scores.append((fits[1].slip_margin - truth) / fits[1].slip_margin_std)
                if any(safe or event.event == "incipient_slip" for event in news):
                    announced = index
                    break
            gross = int(np.argmax(share >= 1.0))
            right += announced == len(frames) if safe else announced < gross
            if not safe:
                leads.append(1e3 * (gross - announced) / RATE_HZ)
        what = "loads with a margin of 0.5 or more, no alarm on" if safe else "ramps to gross slip, announced before on"
        lead = "" if safe else f"; ahead by {min(leads):.0f} ms or more, median {np.median(leads):.0f}"
        print(f"{loads} {what} {right}{lead}")
        print(
            f"    frames with the margin unknown: {unknown} of {len(spent_ms)}; z of the others {rms(scores):.2f};"
            f" ms a frame: median {np.median(spent_ms):.1f}, p99 {np.percentile(spent_ms, 99):.1f}"
        )


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    loads = int(sys.argv[2]) if len(sys.argv) > 2 else 50
    with threadpool_limits(1, user_api="blas"):
        stick_radius(draws)
        net_forces(draws)
        events(loads)


if __name__ == "__main__":
    main()
