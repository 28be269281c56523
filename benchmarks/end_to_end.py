"""Forces, sites and uncertainties from end to end, on emulated plates counted straight into the daemon's chain.

Every row has what is asked and what is seen. Scenes are drawn with fixed seeds, one bench of plate, levels,
temperature coefficients and noise after the other. "Told" means that the plate file says of response and warm touches
what the emulated plate has; it never knows the errors drawn for a plate or a touch. The held presses run at a lower
frame rate, 100 and 25 frames a second. It takes some five minutes.
"""

import argparse
from collections.abc import Sequence

import numpy as np
from end_to_end_cost import Cost, comb_plate, cost, ladder_plate
from end_to_end_held import Held, contacts_of_a_shock, hold, sites_of_a_whole_press
from end_to_end_pairs import Pair, play_pairs
from end_to_end_touches import (
    Played,
    creeping_touches,
    hysteretic_touches,
    ideal_touches,
    short_touches,
    told_plate,
    warm_touches,
)

from resonator_daemon.plate import Plate, load_plate
from simulators.physics import Physics

HELD_SITE = 7
HELD_QUARTZ_HZ, HELD_COMB_HZ = 100.0, 25.0
EQUAL_COEFFICIENTS = Physics(ideal=True, temperature_coefficient=-5e-8)
SITES = (16, 64, 256, 1024)


def row(name: str, seen: str, asked: str = "") -> None:
    print(f"  {name:66s} {seen:>24s}  {asked}", flush=True)


def print_touches(count: int) -> None:
    print(
        f"\nquartz16, {count} touches of 0.2-8 N one after the other; rms error where the force exceeds 5 % of its peak"
    )

    def show(name: str, played: Played, asked: str) -> None:
        row(name, f"{1e3 * played.errors.rms_newton:.2f} mN", asked)
        if played.found < played.touches or played.wrong:
            row("", f"{played.found} found, {played.wrong} readings wrong", f"{played.touches} and 0")

    ideal = ideal_touches(count)
    row(
        "sites found; readings that name another",
        f"{ideal.found}/{ideal.touches}; {ideal.wrong}",
        f"{count}/{count}; 0",
    )
    show("ideal sites", ideal, "<= 3")
    show("creep 0.5 %, 20 s, told", creeping_touches(count, told=True), "<= 10")
    show("    untold", creeping_touches(count, told=False), "")
    show("hysteresis 1 %, told", hysteretic_touches(count, told=True), "<= 35")
    show("    untold", hysteretic_touches(count, told=False), "")
    for measured, name in ((True, "coefficients in the plate file"), (False, "usual coefficients")):
        warm = warm_touches(measured=measured)
        row(f"finger of 305 K, 1 to 60 s, {name}", f"{1e3 * warm.errors.rms_newton:.1f} mN")
        row("    largest error over what is stated", f"{warm.errors.worst_ratio:.2f}", "<= 1" if measured else "<= 2")


def print_short_touches(count: int) -> None:
    print(f"\nquartz16, {count} short touches, every imperfection on, fingers +-3 K, told")
    played = short_touches(count)
    row(
        "sites found; readings that name another",
        f"{played.found}/{played.touches}; {played.wrong}",
        f"{count}/{count}; 0",
    )
    row("said to be possibly more", f"{played.more} of {played.touches} touches")
    for name, errors in (("readings", played.errors), ("touches, one reading each", played.errors.of_touches)):
        row(f"error within 2 sigma, over {name}", f"{100.0 * errors.covered:.1f} %", ">= 93 %")
        ratio = errors.stated_newton / errors.rms_newton
        row(
            "    stated sigma over error, both rms",
            f"{1e3 * errors.stated_newton:.1f} / {1e3 * errors.rms_newton:.1f} mN = {ratio:.2f}",
            "<= 2",
        )


def print_pairs(name: str, count: int, asked: str) -> None:
    print(f"\n{name}, {count} pairs of touches >= 5 mm apart, every imperfection on, told")
    pairs = play_pairs(told_plate(name), count)
    row(
        "readings that name another site, pairs with one",
        f"{sum(p.wrong for p in pairs)}, {sum(p.wrong > 0 for p in pairs)}",
        "0, 0",
    )
    apart, one = [p for p in pairs if p.separable], [p for p in pairs if not p.separable]
    what = "pairs, each the strongest by 1 dB at some corner" if name == "quartz16" else "pairs"
    _print_kind(what, apart, asked)
    if one:
        _print_kind("other pairs, corners within 1 dB among them", one, "")
    if name == "comb16":
        off_mm = 1e3 * np.concatenate([p.apart_m for p in pairs])
        row(
            "    distance of contact and touch, median, 99 %, largest",
            "{:.2f} {:.2f} {:.2f} mm".format(*np.percentile(off_mm, [50, 99, 100])),
        )


def _print_kind(what: str, pairs: Sequence[Pair], asked: str) -> None:
    joint = sum(p.joint for p in pairs)
    row(what, f"{len(pairs)}")
    row(
        "    both found; share of readings",
        f"{100 * np.mean([p.both > 0 for p in pairs]):.1f} %; {100 * sum(p.both for p in pairs) / joint:.1f} %",
        asked,
    )
    if not asked:
        row("    stronger one found", f"{100 * np.mean([p.stronger > 0 for p in pairs]):.1f} %", "all")
    row(
        "    said to be possibly more; share of readings",
        f"{100 * np.mean([p.more > 0 for p in pairs]):.1f} %; {100 * sum(p.more for p in pairs) / joint:.1f} %",
        "" if asked else "all",
    )


def print_held(seconds: float) -> None:
    print(f"\n2 N held for {seconds:g} s while the room swings by +-2 K; errors in mN")

    def show(name: str, held: Held, asked: str) -> None:
        row(f"{name}: mean of the last 10 s", f"{1e3 * held.end_newton:.2f}", asked)
        row(
            "    largest of one reading; stated at the end",
            f"{1e3 * held.largest_newton:.1f}; {1e3 * held.stated_newton:.1f}",
        )
        row("    readings within 2 sigma; with a force", f"{100 * held.covered:.1f} %; {100 * held.told:.1f} %")

    site, contact = hold(at_rate(load_plate("comb16"), HELD_COMB_HZ), EQUAL_COEFFICIENTS, HELD_SITE, seconds)
    show("comb16, ideal, equal coefficients", site, "<= 1")
    show("    its contact, by the fit to all sites", contact, "")
    site, contact = hold(at_rate(told_plate("comb16"), HELD_COMB_HZ), Physics(), HELD_SITE, seconds)
    show("comb16, defaults, told", site, f"<= {2e3 * site.stated_newton:.0f}")
    show("    its contact, by the fit to all sites", contact, f"<= {2e3 * contact.stated_newton:.0f}")
    site, _ = hold(at_rate(told_plate("quartz16"), HELD_QUARTZ_HZ), Physics(), HELD_SITE, seconds)
    show("quartz16, defaults, told", site, f"<= {2e3 * site.stated_newton:.0f}")
    row("comb16, thermal shock of 10 K in 5 s: contacts", f"{contacts_of_a_shock(told_plate('comb16'))}", "0")
    row("comb16, press of the whole plate: sites", f"{sites_of_a_whole_press(told_plate('comb16'))}", "16")


def at_rate(plate: Plate, frame_rate_hz: float) -> Plate:
    return plate.model_copy(update={"counter": plate.counter.model_copy(update={"frame_rate_hz": frame_rate_hz})})


def print_costs() -> None:
    print("\nprocessor time of the chain over the time that its frames last; of that, shares of the stages")

    def show(name: str, of: Cost) -> None:
        shares = ", ".join(f"{stage} {100 * share:.0f} %" for stage, share in of.shares.items())
        print(f"  {name:38s} {of.real_time:6.3f} {1e6 * of.frame_s:8.0f} us a frame   {shares}", flush=True)

    for name in ("quartz16", "comb16"):
        for pressed in (False, True):
            show(f"{name}, {'touched' if pressed else 'untouched'}", cost(told_plate(name), Physics(), pressed=pressed))
    for make, name in ((ladder_plate, "single tone"), (comb_plate, "channelised")):
        costs = [cost(make(sites), Physics(ideal=True), pressed=True) for sites in SITES]
        for sites, of in zip(SITES, costs, strict=True):
            show(f"{name}, {sites} sites: x {of.frame_s / costs[0].frame_s:.2f}", of)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--touches", type=int, default=40)
    parser.add_argument("--short-touches", type=int, default=2000)
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--held-s", type=float, default=600.0)
    arguments = parser.parse_args()
    print_costs()
    print_touches(arguments.touches)
    print_held(arguments.held_s)
    print_short_touches(arguments.short_touches)
    print_pairs("quartz16", arguments.pairs, ">= 95 %")
    print_pairs("comb16", arguments.pairs, ">= 99 %")


if __name__ == "__main__":
    main()
