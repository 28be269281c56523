"""Draws per second of the live page, and its share of the browser's main thread, with a skin at 60 maps/s.

Run it with `python benchmarks/live_page_draws.py [SECONDS]` after `make test-browser`. A scripted server sends the map
of skin32, 37 kB, with its contacts. "layout" and "script" are parts of "main thread"; all are
processor time of that thread, so that other programs do not count.
"""

import asyncio
import sys
import time
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))

from fake_live_page import FakeLivePage, array, contact, decoded, header, hertz, info, served
from playwright.async_api import async_playwright

FRAME_RATE_HZ = 60  # the server sends at most as many maps
DRAWS = "resonatord.views[0].surface.draws"
KEYS = {"TaskDuration": "main thread", "ScriptDuration": "script", "LayoutDuration": "layout"}


async def feed(fake: FakeLivePage) -> None:
    """Send frames until cancelled."""
    maps = [hertz(force, 0.0025) for force in np.linspace(1.0, 1.2, 16)]
    maps = [decoded(m, traction_std_pascal=array(m / 50), displacement_m=array(m * 1e-9)) for m in maps]
    slip = {"slip_margin": 0.6, "slip_margin_std": 0.01, "moment_newton_m": [1e-3, 0, 0]}
    due_s = time.monotonic()
    for seq in range(10**9):
        await fake.send("decoded", maps[seq % len(maps)])
        touch = contact((0.25, 0, 1 + 0.01 * (seq % 16)), **slip)
        await fake.send("contacts", header(seq=seq, status="ok", contacts=[touch]))
        due_s += 1 / FRAME_RATE_HZ
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))


async def main(seconds: float) -> None:
    """Print a line for an idle page and one for a page that draws."""
    print(f"{'page':12} draws/s  {'  '.join(KEYS.values())}  JavaScript heap")
    async with served() as fake, async_playwright() as playwright:
        await fake.send("info", info(skin=True, sites=1024))
        browser = await playwright.chromium.launch(executable_path="/usr/bin/chromium")
        page = await browser.new_page(viewport={"width": 1280, "height": 860})
        session = await page.context.new_cdp_session(page)
        await session.send("Performance.enable", {"timeDomain": "threadTicks"})
        await page.goto(fake.url)
        await page.wait_for_timeout(2000)
        for name in ("idle", "drawing"):
            task = asyncio.create_task(feed(fake)) if name == "drawing" else None
            await page.wait_for_timeout(2000)
            before, begun = await measure(session), (time.monotonic(), await page.evaluate(DRAWS))
            await page.wait_for_timeout(1e3 * seconds)
            after, passed_s = await measure(session), time.monotonic() - begun[0]
            draws = (await page.evaluate(DRAWS) - begun[1]) / passed_s
            shares = "  ".join(f"{(after[key] - before[key]) / passed_s:{len(word)}.1%}" for key, word in KEYS.items())
            print(f"{name:12} {draws:7.1f}  {shares}  {after['JSHeapUsedSize'] / 1e6:.1f} MB")
            if task:
                task.cancel()
        await browser.close()


async def measure(session) -> dict[str, float]:  # type: ignore[no-untyped-def]
    return {entry["name"]: entry["value"] for entry in (await session.send("Performance.getMetrics"))["metrics"]}


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0))
