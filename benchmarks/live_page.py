"""What the live page costs while browsers follow a skin, and how soon a press of the mouse shows on it.

Run it with `python benchmarks/live_page.py relay|press`. Relay: `resonatord view` while 0, 1 and 5 browsers follow
skin32 at full rate. Exit code 1 if five cost more than 5 % of a core. Press:
from the mouse at random moments to a changed pixel of the map, 0.8 mm away, outside the page's own marks, read in each
frame after the page has drawn. It needs the browser of `make test-browser`. Exit code 1 if the median is above 40 ms,
the 95th percentile above 80 ms, or the first paint above 1 s.
"""

import argparse
import asyncio
import json
import random
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, ExitStack
from pathlib import Path

import aiohttp
import aiomqtt
import numpy as np
from parts import COMMAND, broker, child, processor_s, running

SIZES = {"decoded": 37_200, "decoded/summary": 283, "contacts": 211}  # bytes of skin32's messages with one contact
SIGNALS = {"signals": 24_800}
FRAME_RATE_HZ, RELAY_MAX_PERCENT = 100, 5.0
CHROMIUM = "/usr/bin/chromium"
MEDIAN_MAX_MS, P95_MAX_MS, PAINT_MAX_MS = 40.0, 80.0, 1000.0
PLACES = ((0.3, 0.3), (0.7, 0.35), (0.35, 0.7), (0.65, 0.65))  # shares of the drawing's width and height
AWAY_PX = (-22, -14)
# The page draws in callbacks of the same frame that were requested before this one.
WATCH = """([x, y]) => {
  const canvas = document.elementFromPoint(x, y), box = canvas.getBoundingClientRect();
  const context = canvas.getContext("2d");
  const column = (x - box.left) * canvas.width / box.width, row = (y - box.top) * canvas.height / box.height;
  const read = () => context.getImageData(Math.round(column), Math.round(row), 1, 1).data.join();
  window.changed = new Promise((resolve) => {
    canvas.addEventListener("pointerdown", (event) => {
      const before = read();
      const look = () => {
        if (read() === before) requestAnimationFrame(look); else resolve(performance.now() - event.timeStamp);
      };
      requestAnimationFrame(look);
    }, { once: true, capture: true });
  });
}"""


async def publish(port: int) -> None:
    """Publish frames until cancelled, each when it is due."""
    async with aiomqtt.Client("127.0.0.1", port) as client:
        due_s = time.monotonic()
        while True:
            for path, size in (SIZES | SIGNALS).items():
                await client.publish(f"resonator/bench/{path}", bytes(size))
            due_s += 1 / FRAME_RATE_HZ
            await asyncio.sleep(due_s - time.monotonic())


async def follow(url: str, seconds: float, topics: list[str]) -> int:
    """Return how many maps a browser receives."""
    maps = 0
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{url}ws", max_msg_size=0) as browser:
        await browser.send_str(json.dumps({"watch": {"plate": "bench", "topics": topics}}))
        try:
            async with asyncio.timeout(seconds):
                async for message in browser:
                    is_map = message.type is aiohttp.WSMsgType.BINARY
                    maps += is_map and message.data[1:].startswith(b"live/bench/decoded\0")
        except TimeoutError:
            pass
    return maps


async def relay(seconds: float) -> int:
    percents = {}
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        port = stack.enter_context(broker(folder))
        words = ("view", "--url", f"mqtt://127.0.0.1:{port}", "--listen", "127.0.0.1:0", "--json")
        view = stack.enter_context(child(*COMMAND, *words, stdout=subprocess.PIPE))
        assert view.stdout is not None  # noqa: S101 - it is a pipe
        url = json.loads(await asyncio.to_thread(view.stdout.readline))["url"]
        publishing = asyncio.create_task(publish(port))
        stack.callback(publishing.cancel)
        print(f"{'browsers':>12} {'streams':>8} {'% of a core':>12} {'maps/s each':>12}")
        maps, everything = sorted(SIZES), sorted(SIZES | SIGNALS)
        for name, count, topics in (("0", 0, maps), ("1", 1, maps), ("5", 5, maps), ("5", 5, everything)):
            followers = [asyncio.create_task(follow(url, seconds + 2.0, topics)) for _ in range(count)]
            await asyncio.sleep(1.0)
            before_s, began_s = processor_s(view.pid), time.monotonic()
            await asyncio.sleep(seconds)
            percent = 100.0 * (processor_s(view.pid) - before_s) / (time.monotonic() - began_s)
            rate_hz = sum(await asyncio.gather(*followers)) / max(count, 1) / (seconds + 2.0)
            percents[name, len(topics)] = percent
            print(f"{name:>12} {len(topics):>8} {percent:>12.1f} {rate_hz:>12.1f}", flush=True)
    return int(percents["5", len(SIZES)] > RELAY_MAX_PERCENT)


def press(presses: int) -> int:
    from playwright.sync_api import sync_playwright

    moments, found_ms = random.Random(1), list[float]()
    with ExitStack() as stack:
        control = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "control"
        system = stack.enter_context(running("skin32", "--scenario", "still", "--control", str(control)))
        words = ("view", "--url", f"mqtt://127.0.0.1:{system.port}", "--listen", "127.0.0.1:0", "--press", str(control))
        server = stack.enter_context(child(*COMMAND, *words, "--json", stdout=subprocess.PIPE))
        assert server.stdout is not None  # noqa: S101 - it is a pipe
        url = json.loads(server.stdout.readline())["url"]
        browser = stack.enter_context(sync_playwright()).chromium.launch(executable_path=CHROMIUM)
        stack.callback(browser.close)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.wait_for_selector("canvas:visible")
        time.sleep(2.0)  # the first maps
        paint_ms = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
        box = page.locator("canvas.scene:visible").first.bounding_box()
        assert box is not None  # noqa: S101 - it is visible
        for number in range(presses):
            time.sleep(moments.uniform(0.6, 0.7))
            across, down = PLACES[number % len(PLACES)]
            x, y = box["x"] + across * box["width"], box["y"] + down * box["height"]
            page.mouse.move(x, y)
            page.evaluate(WATCH, [x + AWAY_PX[0], y + AWAY_PX[1]])
            page.mouse.down()
            found_ms.append(float(page.evaluate("changed")))
            page.mouse.up()
    median_ms, p95_ms = np.percentile(found_ms, [50, 95])
    figures = f"median {median_ms:.1f} ms, 95 % {p95_ms:.1f} ms, largest {max(found_ms):.1f} ms"
    print(f"first paint {paint_ms:.0f} ms; press to pixel, {presses} presses: {figures}")
    return int(median_ms > MEDIAN_MAX_MS or p95_ms > P95_MAX_MS or paint_ms > PAINT_MAX_MS)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=("relay", "press"))
    parser.add_argument("--count", type=int, help="seconds of each case of the relay (10), or presses (60)")
    options = parser.parse_args()
    return asyncio.run(relay(options.count or 10)) if options.figure == "relay" else press(options.count or 60)


if __name__ == "__main__":
    sys.exit(main())
