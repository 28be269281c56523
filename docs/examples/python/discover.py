"""Lists every plate on a broker and draws each from `info` alone: discover.py [HOST [PORT [PREFIX [FOLDER]]]]."""

import asyncio
import contextlib
import math
import sys
from html import escape
from pathlib import Path
from urllib.parse import quote

import resonatord

QUIET_S = 1.0  # retained messages come at once: after such a silence there are no more
LABELLED_MAX = 64  # sites; with more of them their numbers would hide them

host, port, prefix, folder = sys.argv[1:] + ["127.0.0.1", "1883", "resonator", "."][len(sys.argv) - 1 :]


async def discover():
    """Return `info` and `state/daemon` of each plate, by its name."""
    plates = {}
    broker = resonatord.Mqtt(url=f"mqtt://{host}:{port}", prefix=prefix)
    messages = resonatord.subscribe(broker, topics=["info", "state/daemon"])
    with contextlib.suppress(TimeoutError):
        while True:
            plate, path, message = await asyncio.wait_for(anext(messages), QUIET_S)
            plates.setdefault(plate, {})[path] = message
    return plates


def describe(name, info, state):
    """Return a description of a plate, one line for each property."""
    condition = state.state if state else "unknown"
    calibration = info.calibration
    valid = f"valid until {calibration.expiry}" if calibration.expiry else "no expiry date"
    rates = ", ".join(f"{topic} {rate:g}/s" for topic, rate in info.rates_hz.items())
    return [
        f"{name}: {condition}, {info.plate}, {len(info.sites)} sites up to {info.force_max_newton:g} N, {info.counter}",
        f"board {info.serial_number}, {info.product} {info.firmware}, {info.frame_rate_hz:g} frames/s",
        f"calibration {calibration.id or 'not named'}, {valid}",
        f"publishes {rates}",
    ]


def draw(info, lines):
    """Return a plate as SVG, 1 unit = 1 mm: outline, transducers in the order of the channels, sites."""
    outline, transducers = ([to_mm(point) for point in places] for places in (info.outline_m, info.transducers_m))
    left, top = (min(point[axis] for point in outline) for axis in (0, 1))
    width, height = (max(point[axis] for point in outline) - start for axis, start in ((0, left), (1, top)))
    radius, border = 0.25 * math.sqrt(width * height / max(len(info.sites), 1)), 0.1 * max(width, height)
    letters = 0.3 * border
    parts = [f'<polygon points="{" ".join(f"{x:.6g},{y:.6g}" for x, y in outline)}" fill="#eef" stroke="#88a"/>']
    for channel, (x, y) in enumerate(transducers):
        parts.append(f'<circle class="transducer" cx="{x:.6g}" cy="{y:.6g}" r="{letters:.6g}" fill="#a60"/>')
        parts.append(text(x, y - 1.2 * letters, f"channel {channel}", letters, "middle"))
    for site in info.sites:
        x, y = to_mm(site.position_m)
        mark = f'<circle class="site" cx="{x:.6g}" cy="{y:.6g}" r="{radius:.6g}" fill="#7ac">'
        parts.append(f"{mark}<title>{site.site}</title></circle>")
        if len(info.sites) <= LABELLED_MAX:
            parts.append(text(x, y + 0.3 * radius, str(site.site), radius, "middle"))
    for number, line in enumerate(lines, 2):
        parts.append(text(left, top + height + border / 2 + 1.5 * number * letters, line, letters, "start"))
    box = left - border, top - border, width + 2 * border, height + 2 * border + 1.5 * (len(lines) + 1) * letters
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{" ".join(f"{edge:.6g}" for edge in box)}"'
    return "\n".join([f'{head} stroke-width="{0.1 * letters:.6g}">', *parts, "</svg>\n"])


def to_mm(point_m):
    """Return a place on the plate in the picture; in both x is to the right and y downwards."""
    return 1e3 * point_m[0], 1e3 * point_m[1]


def text(x, y, words, size, anchor):
    place = f'x="{x:.6g}" y="{y:.6g}" font-size="{size:.6g}" text-anchor="{anchor}"'
    return f'<text {place} font-family="sans-serif">{escape(words)}</text>'


try:
    found = asyncio.run(discover())
except resonatord.UserError as error:
    sys.exit(str(error))
for name, published in sorted(found.items()):
    state = published.get("state/daemon")
    if "info" not in published:
        print(f"{name}: {state.state}, has published no info")
        continue
    lines = describe(name, published["info"], state)
    picture = Path(folder) / f"{quote(name, safe='')}.svg"
    picture.write_text(draw(published["info"], lines))
    print("\n  ".join([*lines, f"drawn in {picture}"]))
