"""Parametric fit of one contact under 16 sites: errors of its place and force, and whether error bars hold.

Run it with `python benchmarks/parametric_fit.py [CONTACTS]`. Truth is closed-form; noise is that below the peak of the
signal 3 p_n / (2 E) right under a contact. One thread of linear algebra.
"""

import sys
import time

import numpy as np
from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.fitting.parametric_decoder import ParametricDecoder
from resonator_daemon.elastic import HalfSpace
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

YOUNGS_PASCAL, NU, RADIUS_M, FRICTION = 2e5, 0.5, 2e-3, 0.5
UNITS = np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])
CASES = [(depth_mm, decibel) for depth_mm in (1.0, 2.0, 3.0) for decibel in (40, 30, 20)]


def signals(sites_m: Floats, depth_m: float, force_newton: Floats) -> Floats:
    """Of a contact at the origin, (3, n)."""
    radii, forces = hertz_parts(force_newton, RADIUS_M, FRICTION)
    fields = hertz_fields(sites_m, depth_m, radii, YOUNGS_PASCAL, NU)
    return np.asarray(np.einsum("kf,kfsn->sn", forces, fields) * UNITS)


def row(sites_m: Floats, depth_m: float, decibel: float, shear: float, contacts: int) -> str:
    rng = np.random.default_rng(1)
    peak = float(signals(np.zeros((1, 2)), depth_m, np.array([0.0, 0.0, 1.0]))[0, 0])
    std = abs(peak) * 10 ** (-decibel / 20)
    decoder = ParametricDecoder(HalfSpace(YOUNGS_PASCAL, NU), sites_m, depth_m, std)
    apart, force, scores, statuses, times = [], [], [], [], []
    for _ in range(contacts):
        centre, angle = rng.uniform(-7.5e-3, 7.5e-3, 2), rng.uniform(0.0, 2.0 * np.pi)
        truth = np.array([shear * np.cos(angle), shear * np.sin(angle), 1.0])
        frame = signals(sites_m - centre, depth_m, truth) + std * rng.standard_normal((3, len(sites_m)))
        start = time.perf_counter()
        decoded, patch = decoder.decode_with_patch(frame)
        times.append(time.perf_counter() - start)
        statuses.append(decoded.status)
        if patch is not None:
            apart.append(np.hypot(*(patch.centroid_m - centre)) * 1e3)
            force.append(patch.force_newton)
            off = np.concatenate([patch.centroid_m - centre, patch.force_newton - truth])
            scores.append(off / np.concatenate([patch.centroid_std_m, patch.force_std_newton]))
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    normal = np.array(force)[:, 2]
    low, high = np.percentile(normal, [25, 75])
    return (
        f"{depth_m * 1e3:4.0f} {decibel:5.0f} {shear:6.1f} {len(apart) / contacts:7.0%} "
        f"{statuses.count('ambiguous') / contacts:9.0%} {np.median(apart):9.3f} {np.percentile(apart, 95):7.2f} "
        f"{np.median(normal):7.3f} {high - low:7.3f}   {rms[:2].mean():5.2f} {rms[2:4].mean():5.2f} {rms[4]:5.2f} "
        f"{np.median(times) * 1e3:6.1f}"
    )


def main(contacts: int) -> None:
    axis = (np.arange(4) - 1.5) * 5e-3
    sites_m = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    sites_m += np.random.default_rng(0).uniform(-1e-3, 1e-3, sites_m.shape)
    print("16 jittered sites on 20 mm x 20 mm, contacts of 1 N and 2 mm radius within +- 7.5 mm")
    print("  z    SNR  shear   found ambiguous   location error      force, F_z       rms of z-scores      time")
    print(" mm     dB      N                    median    95 %   median   inter-    x, y   F_t   F_z     ms")
    print("                                         mm      mm        N quartile")
    for shear in (0.0, 0.3):
        for depth_mm, decibel in CASES:
            print(row(sites_m, depth_mm * 1e-3, decibel, shear, contacts), flush=True)


if __name__ == "__main__":
    with threadpool_limits(1, user_api="blas"):
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
