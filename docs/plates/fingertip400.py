"""Make the plate file of `fingertip400`: 400 irregular sites inside a fingertip's outline, denser in the middle.

Run it with `python docs/plates/fingertip400.py > fingertip400.toml`; change what stands in capitals for a plate of your
own. Each site is, of many random candidates, the one that is farthest from all sites before it, by the spacing that is
wanted there (Mitchell, "Spectrally optimal sampling for distribution ray tracing", 1991).
"""

import math
import random

Point = tuple[float, float]

SITES, CANDIDATES, SEED = 400, 200, 400
WIDTH_MM, LENGTH_MM = 14.0, 18.0
TIP_RADIUS_MM, BASE_RADIUS_MM = 7.0, 3.0  # of the corners at y > 0 and y < 0
MARGIN_MM = 0.5  # that sites keep from the outline
WIDENING_MM = 8.0  # at this distance from the middle sites lie twice as far apart as there
NEAR_MM, APART = 1.5, 24  # sites this near to each other have tones at least so many sites apart
F0_HZ, SPACING_HZ = 100_000_000, 8000  # of tone k: F0_HZ + k SPACING_HZ
SENSITIVITY = {"p_n": "-2.0e-11", "eps_xz": "2.7e-6", "eps_yz": "2.7e-6"}  # 1/Pa, 1/strain, 1/strain

HEAD = """\
# 400 sites of three signals under the soft skin of a fingertip, placed irregularly and denser in the middle; all
# 1200 tones are received at once. Made by docs/plates/fingertip400.py.
# Tone k, in the order of this file, lies at {f0_mhz:g} MHz + {spacing_khz:g} kHz k. Tones of two sites within
# {near:g} mm of each other lie at least {apart_khz:g} kHz apart.
format = 1
name = "fingertip400"
outline_mm = [
{outline}
]
transducers_mm = [[-6.0, -7.5], [6.0, -7.5], [4.5, 6.5], [-4.5, 6.5]]
force_max_newton = 5

[counter]
kind = "channelised"
reference_hz = 250e6
frame_rate_hz = 100

[skin]
youngs_modulus_pascal = 2e5
poisson_ratio = 0.5
depth_mm = 1.0
gain_std = 0.01                               # of each signal by itself
depth_std_mm = 0.05                           # this and what follows as made; `resonatord calibrate skin` finds better
modulus_std_pascal = 1e4
gain_std_common = 0.05
position_std_mm = 0.02
"""


def depth_inside_mm(place: Point) -> float:
    """Distance to the outline, a rectangle with rounded corners; negative outside."""
    radius = TIP_RADIUS_MM if place[1] > 0.0 else BASE_RADIUS_MM
    x, y = abs(place[0]) - WIDTH_MM / 2 + radius, abs(place[1]) - LENGTH_MM / 2 + radius
    return radius - min(max(x, y), 0.0) - math.hypot(max(x, 0.0), max(y, 0.0))


def outline_mm() -> list[Point]:
    """Corners of the outline from that of least x and y on, the arcs in steps of 10 degrees."""
    corners = []
    for sign_x, sign_y, begin in ((-1, -1, 18), (1, -1, 27), (1, 1, 0), (-1, 1, 9)):
        radius = TIP_RADIUS_MM if sign_y > 0 else BASE_RADIUS_MM
        x, y = sign_x * (WIDTH_MM / 2 - radius), sign_y * (LENGTH_MM / 2 - radius)
        for step in range(begin, begin + 10):
            angle = math.radians(10 * step)
            corners.append((round(x + radius * math.cos(angle), 3), round(y + radius * math.sin(angle), 3)))
    return list(dict.fromkeys(corners))  # arcs that meet share a corner


def sites_mm(rng: random.Random) -> list[Point]:
    sites: list[Point] = []
    while len(sites) < SITES:
        candidates: list[Point] = []
        while len(candidates) < CANDIDATES:
            place = ((rng.random() - 0.5) * WIDTH_MM, (rng.random() - 0.5) * LENGTH_MM)
            if depth_inside_mm(place) >= MARGIN_MM:
                candidates.append((round(place[0], 3), round(place[1], 3)))
        sites.append(max(candidates, key=lambda place: room(place, sites)))
    return sites


def room(place: Point, sites: list[Point]) -> float:
    """Distance to the nearest site over the spacing wanted at this place, relative to that in the middle."""
    nearest = min((math.dist(place, site) for site in sites), default=math.inf)
    return nearest / (1.0 + (math.hypot(*place) / WIDENING_MM) ** 2)


def spread_out(sites: list[Point]) -> list[Point]:
    """Put the sites into an order in which near ones are far apart: their resonances must not couple."""
    left, ordered = set(sites), list[Point]()
    while left:
        last = ordered[-APART + 1 :]
        fits = [site for site in sorted(left) if all(math.dist(site, one) > NEAR_MM for one in last)]
        if not fits:
            raise ValueError(f"{SITES} sites within {NEAR_MM} mm cannot be {APART} apart: lower APART")
        # Where most are left is where they would run out of room.
        ordered.append(max(fits, key=lambda site: sum(math.dist(site, other) <= NEAR_MM for other in left)))
        left.remove(ordered[-1])
    return ordered


def main() -> None:
    ordered = spread_out(sites_mm(random.Random(SEED)))
    corners = [f"[{x:g}, {y:g}]" for x, y in outline_mm()]
    rows = (", ".join(corners[first : first + 6]) for first in range(0, len(corners), 6))
    apart_khz = ((APART - 1) * len(SENSITIVITY) + 1) * SPACING_HZ / 1e3
    print(
        HEAD.format(
            f0_mhz=F0_HZ / 1e6,
            spacing_khz=SPACING_HZ / 1e3,
            near=NEAR_MM,
            apart_khz=apart_khz,
            outline=",\n".join(f"  {row}" for row in rows),
        )
    )
    tone = 0
    for number, (x, y) in enumerate(ordered, 1):
        print(f"[[sites]]\nid = {number}\nposition_mm = [{x:g}, {y:g}]\ntones = [")
        for signal, sensitivity in SENSITIVITY.items():
            f0_hz = ", ".join([f"{(F0_HZ + SPACING_HZ * tone) // 1000}e3"] * 4)
            print(f'  {{ signal = "{signal}", f0_hz = [{f0_hz}], sensitivity = [{", ".join([sensitivity] * 4)}] }},')
            tone += 1
        print("]")


if __name__ == "__main__":
    main()
