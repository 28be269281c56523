"""Time from a press of the mouse in the live page to a changed pixel of the map, and to the first paint.

Run it with `python benchmarks/press_to_pixel.py [--presses N]`, after `make test-browser` has installed the browser.
It starts an emulated skin32, Mosquitto, a daemon, `view` and a browser without a window, and presses at random
moments. The time of a press is that of its `pointerdown` event; the pixel is 0.8 mm away from the press, outside the
marks that the page itself draws there. It is read in each frame after the page has drawn. Exit code 1 if the median is
above 40 ms, the 95th percentile above 80 ms, or the first paint above 1 s.
"""

import argparse
import json
import random
import subprocess
import sys
import time
from contextlib import ExitStack

import numpy as np
from playwright.sync_api import Page, sync_playwright
from press_latency import CLI, measured
from system_parts import child

CHROMIUM = "/usr/bin/chromium"
MEDIAN_MAX_MS, P95_MAX_MS, PAINT_MAX_MS = 40.0, 80.0, 1000.0
PLACES = ((0.3, 0.3), (0.7, 0.35), (0.35, 0.7), (0.65, 0.65))  # shares of the drawing's width and height
AWAY_PX = (-22, -14)

# The page draws in callbacks of the same frame that were requested before this one.
WATCH = """([x, y]) => {
  const canvas = document.elementFromPoint(x, y), box = canvas.getBoundingClientRect();
  const context = canvas.getContext("2d");
  const read = () => context.getImageData(
    Math.round((x - box.left) * canvas.width / box.width), Math.round((y - box.top) * canvas.height / box.height), 1, 1
  ).data.join();
  window.changed = new Promise((resolve) => {
    canvas.addEventListener("pointerdown", (event) => {
      const before = read();
      const look = () => {
        if (read() === before) requestAnimationFrame(look);
        else resolve(performance.now() - event.timeStamp);
      };
      requestAnimationFrame(look);
    }, { once: true, capture: true });
  });
}"""


def press_ms(page: Page, place: tuple[float, float]) -> float:
    """Press for as long as the pixel takes to change; return how long that was."""
    box = page.locator("canvas:visible").first.bounding_box()
    assert box is not None  # noqa: S101 - it is visible
    x, y = box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"]
    page.mouse.move(x, y)
    page.evaluate(WATCH, [x + AWAY_PX[0], y + AWAY_PX[1]])
    page.mouse.down()
    found = float(page.evaluate("changed"))
    page.mouse.up()
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=60, help="default: %(default)s")
    options = parser.parse_args()
    moments = random.Random(1)
    with ExitStack() as stack:
        _, control, forces = stack.enter_context(measured("skin32", "contacts", control=True))
        view = ("view", "--url", forces.broker_url, "--listen", "127.0.0.1:0", "--press", str(control), "--json")
        server = stack.enter_context(child(*CLI, *view, stdout=subprocess.PIPE))
        assert server.stdout is not None  # noqa: S101 - it is a pipe
        url = json.loads(server.stdout.readline())["url"]
        browser = stack.enter_context(sync_playwright()).chromium.launch(executable_path=CHROMIUM)
        stack.callback(browser.close)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.wait_for_selector("canvas:visible")
        time.sleep(2.0)  # the first maps
        paint_ms = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
        found_ms = []
        for number in range(options.presses):
            time.sleep(moments.uniform(0.6, 0.7))
            found_ms.append(press_ms(page, PLACES[number % len(PLACES)]))
    median_ms, p95_ms = np.percentile(found_ms, [50, 95])
    print(
        f"first paint {paint_ms:.0f} ms; press to pixel, {len(found_ms)} presses: "
        f"median {median_ms:.1f} ms, 95 % {p95_ms:.1f} ms, largest {max(found_ms):.1f} ms"
    )
    return int(median_ms > MEDIAN_MAX_MS or p95_ms > P95_MAX_MS or paint_ms > PAINT_MAX_MS)


if __name__ == "__main__":
    sys.exit(main())
