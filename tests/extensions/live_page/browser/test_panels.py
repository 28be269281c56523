"""What each part of the page shows of payloads whose values are known, and what it asks the server for."""

import re
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
from conftest import AXE
from fake_live_page import PAGE, FakeLivePage, array, contact, decoded, header, hertz, info
from playwright.async_api import Page, expect

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]
Open = Callable[..., Awaitable[Page]]

SCENE = "const { scene } = resonatord.views[0][selector.slice(1).split('-')[0]];"
RED_GREEN_BLUE = f"""([selector, x, y]) => {{ {SCENE} const at = [scene.x(x), scene.y(y)].map((px) => px * scene.ratio);
  return [...scene.context.getImageData(...at, 1, 1).data.slice(0, 3)]; }}"""
PLACE = f"""([selector, x, y]) => {{ {SCENE} const box = scene.canvas.getBoundingClientRect();
  return [box.left + scene.x(x), box.top + scene.y(y)]; }}"""
SURFACE, PLATE = ".surface-panel canvas.scene", ".plate-panel canvas.scene"
YELLOW, WHITE = (253, 231, 37), (247, 247, 247)  # top of viridis, middle of the diverging map
ONLINE = {part: {"state": "online", "connections": 1, "boot_count": 1} for part in ("daemon", "link", "sensor")}


async def colour(page: Page, selector: str, x: float, y: float) -> np.ndarray:
    return np.array(await page.evaluate(RED_GREEN_BLUE, [selector, x, y]))


async def drawn(page: Page) -> None:
    """Wait until the newest frame is drawn, and its text."""
    await page.evaluate("new Promise((ok) => setTimeout(() => requestAnimationFrame(ok), 250))")


async def place(page: Page, selector: str, x: float, y: float) -> tuple[float, float]:
    """Return the pixel of the window at a position of the plate in metres, scrolled into view."""
    await page.locator(selector).scroll_into_view_if_needed()
    return tuple(await page.evaluate(PLACE, [selector, x, y]))


async def send_states(fake: FakeLivePage, states: dict[str, dict[str, Any]]) -> None:
    for part, keys in states.items():
        known = header(reason_code="measuring", reason="why it is so", since_t_ns="1789000000000000000")
        await fake.send(f"state/{part}", known | keys)


async def test_plate_shows_touched_sites_with_uncertainty(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info())
    page = await open_page()
    await drawn(page)
    before = await colour(page, PLATE, -0.008, 0.0052)
    sites = [
        {"site": 1, "force_newton": 4.0, "noise_newton": 0.03, "systematic_newton": 0.04, "status": "ok"},
        {"site": 2, "force_newton": None, "at_least_newton": 10.0, "noise_newton": None, "status": "overload"},
    ]
    await fake.send("forces", header(status="ok", window_s=0.01, sites=sites))
    await expect(page.locator(".touched li")).to_have_count(2)
    one, two = await page.locator(".touched li").all_inner_texts()
    assert "Site 1" in one
    assert "4.000 ± 0.050 N" in one
    assert "more than 10.0 N" in two
    assert "overload" in two
    await drawn(page)
    assert (await colour(page, PLATE, -0.008, 0.0052) != before).any()
    await expect(page.locator(".identification")).to_be_visible()
    await expect(page.locator(".surface-panel")).to_be_hidden()


async def test_a_touch_whose_site_is_not_identified_is_no_absence(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info())
    page = await open_page()
    await fake.send("contacts", header(status="rejected", reason_code="tones_alike", contacts=[]))
    for panel in (".contacts-panel", ".plate-panel"):
        await expect(page.locator(panel)).to_contain_text("tones alike")
        await expect(page.locator(panel)).not_to_contain_text("Nothing touches")
    await expect(page.locator(".chart-summary")).to_have_text("normal force now \N{EN DASH} N")


async def test_surface_has_the_colours_of_its_scale(fake: FakeLivePage, open_page: Open) -> None:
    grid = {"origin_m": [-0.0062, -0.0062], "pitch_m": 0.0004, "shape": [32, 32]}
    await fake.send("info", info(skin=True, grid=grid))
    page = await open_page()
    traction = np.zeros((3, 32, 32))
    traction[2, :16], traction[2, 0, 0] = 50e3, np.nan
    await fake.send("decoded", decoded(traction, traction_std_pascal=array(traction / 50)))
    await fake.send("contacts", header(status="ok", contacts=[contact((0, 0, 1))]))
    await expect(page.locator(".scale span").last).to_have_text("50 kPa")
    assert np.abs(await colour(page, SURFACE, 0.003, -0.003) - YELLOW).max() <= 3
    assert np.abs(await colour(page, SURFACE, 0.003, 0.003) - (68, 1, 84)).max() <= 3
    await page.select_option(".surface-panel select", "std")
    await expect(page.locator(".scale span").last).to_have_text("1 kPa")
    assert await page.locator("option[value=displacement]").is_disabled()
    await fake.send("decoded", decoded(hertz(1.0, 0.0025), traction_std_pascal=array(np.full((3, 32, 32), 1e5))))
    await expect(page.locator(".longest")).to_contain_text("no shear above its noise")
    reason = {"reason_code": "sensor_suspect", "reason": "why", "suspect_sites": [2]}
    before = await colour(page, SURFACE, 0.008, 0.004)
    await send_states(fake, ONLINE | {"sensor": {"state": "online"} | reason})
    await drawn(page)
    assert (await colour(page, SURFACE, 0.008, 0.004) != before).any()


RELIEF = ".relief canvas"


def pressed(depth_m: float, **keys: Any) -> bytes:
    """Return a map whose skin is pressed in by so much at the origin."""
    displacement = np.zeros((3, 32, 32))
    displacement[2] = depth_m * hertz(1.0, 0.003)[2] / hertz(1.0, 0.003)[2].max()
    return decoded(hertz(1.0, 0.003), displacement_m=array(displacement), **keys)


async def show_relief(page: Page) -> None:
    await page.locator(".relief-switch").evaluate("it => it.click()")  # also while a force plate is shown
    await page.wait_for_function("() => resonatord.views[0].surface.relief.isShown")


async def height_px(page: Page, kind: str) -> float:
    """Return where the mark of this kind is drawn, in pixels from above."""
    return float(await page.locator(f".relief-labels .{kind}").evaluate("it => parseFloat(it.style.top)"))


async def test_relief_is_loaded_when_chosen_and_shows_the_displacement(fake: FakeLivePage, open_page: Open) -> None:
    requested: list[str] = []
    await fake.send("info", info(skin=True))
    page = await open_page()
    page.on("request", lambda request: requested.append(request.url))
    await page.reload()
    await page.wait_for_function("() => resonatord.isOpen")
    await fake.send("decoded", pressed(0.2e-3))
    await fake.send("contacts", header(status="ok", contacts=[contact()]))
    await expect(page.locator(".scale")).to_contain_text("kPa")
    assert [url for url in requested if "three" in url] == []
    assert len([url for url in requested if "main.js" in url]) == 1
    await show_relief(page)
    assert len([url for url in requested if "three" in url]) == 1
    await expect(page.locator(SURFACE)).to_be_hidden()
    text = page.locator(".longest")
    await expect(text).to_contain_text("height \N{MULTIPLICATION SIGN} 20, deepest 200 µm")
    await fake.send_text(truth={"plate": "p", "contacts": [{"position_m": [0, 0], "force_newton": [0, 0, 1]}]})
    shallow = await height_px(page, "truth")
    before = await page.locator(RELIEF).screenshot()
    await fake.send("decoded", pressed(0.215e-3))
    await expect(text).to_contain_text("height \N{MULTIPLICATION SIGN} 20, deepest 215 µm")
    label = page.get_by_role("img", name="Relief of the skin")
    await expect(label).to_have_attribute("aria-label", re.compile("deepest 215 µm"))
    assert await height_px(page, "truth") > shallow
    assert await page.locator(RELIEF).screenshot() != before
    await fake.send("decoded", pressed(0.3e-3))  # too deep for that exaggeration
    await expect(text).to_contain_text("height \N{MULTIPLICATION SIGN} 10, deepest 300 µm")
    for contacts, times in (([], 10), ([contact()], 20)):  # an equal press looks as the first
        await fake.send("contacts", header(status="ok", contacts=contacts))
        await fake.send("decoded", pressed(0.2e-3))
        await expect(text).to_contain_text(f"height \N{MULTIPLICATION SIGN} {times}, deepest 200 µm")
    flat = await page.locator(RELIEF).evaluate("it => it.clientHeight / 2")  # the origin, at which the camera looks
    await fake.send("decoded", decoded(hertz(1.0, 0.003)))
    await expect(text).to_contain_text("no displacement was published")
    assert await height_px(page, "truth") == pytest.approx(flat, abs=0.5)
    await fake.send("decoded", pressed(0.3e-3, traction_std_pascal=array(np.ones((3, 7)))))  # not one for each pixel
    await expect(text).to_contain_text("deepest")
    await fake.send("state/daemon", header(state="offline", reason_code="connection_lost", daemon_boot_id=""))
    await expect(page.locator(".stale-note")).to_contain_text("Last map")
    await page.select_option(".surface-panel select", "std")
    await expect(text).not_to_contain_text("deepest")
    await expect(page.locator(".view")).to_have_class(re.compile("stale"))
    assert float(await page.locator(".relief").evaluate("it => getComputedStyle(it.parentElement).opacity")) < 1
    await page.locator(".relief-switch").uncheck()
    await expect(page.locator(SURFACE)).to_be_visible()
    await expect(page.locator(RELIEF)).to_be_hidden()


async def test_relief_is_turned_and_pressed(fake: FakeLivePage, open_page: Open) -> None:
    fake.hello["press"] = ["p"]
    await fake.send("info", info(skin=True))
    page = await open_page()
    await fake.send("decoded", pressed(0.2e-3))
    await show_relief(page)
    relief = page.locator(RELIEF)
    await expect(page.locator(".press-panel")).to_be_visible()
    box = await relief.evaluate("it => it.getBoundingClientRect().toJSON()")
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2  # the middle of the plate
    first = page.locator(".relief-labels .transducer").first
    at = await first.bounding_box()
    await page.mouse.move(x, y)
    await page.mouse.down(button="right")
    await page.mouse.move(x + 60, y, steps=3)
    await expect(relief).to_have_attribute("data-azimuth", "-50")  # half a degree a pixel
    await drawn(page)
    assert await first.bounding_box() != at
    await page.mouse.move(x + 60, y - 20, steps=3)
    await page.mouse.up(button="right")
    await expect(relief).to_have_attribute("data-elevation", "30")
    assert fake.asked("press") == []
    await page.mouse.move(x, y)
    await page.mouse.down()
    assert (await fake.until("press"))[0]["position_m"] == pytest.approx([0, 0], abs=2e-4)
    await page.mouse.up()
    await relief.focus()
    for _ in range(3):
        await page.keyboard.press("ArrowLeft")
    await page.keyboard.press("ArrowUp")
    await expect(relief).to_have_attribute("data-azimuth", "-80")
    await expect(relief).to_have_attribute("data-elevation", "35")
    for _ in range(20):
        await page.keyboard.press("ArrowUp")
    await expect(relief).to_have_attribute("data-elevation", "90")
    await page.keyboard.press("Home")
    await expect(relief).to_have_attribute("data-azimuth", "-20")
    count = len(fake.asked("press"))
    await page.keyboard.down("Space")  # where the keys have moved no cursor
    assert (await fake.until("press", count + 1))[-1]["position_m"] == pytest.approx([0, 0])
    await page.keyboard.up("Space")
    await fake.until("release", 2)
    session = await page.context.new_cdp_session(page)
    for kind, *places in (("touchStart", x), ("touchStart", x, x + 40), ("touchMove", x + 60, x + 100)):
        points = [{"x": place, "y": y, "id": finger} for finger, place in enumerate(places)]
        await session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    await expect(relief).to_have_attribute("data-azimuth", "-50")  # the second finger ends the press of the first
    assert (await fake.until("release", 3))[-1]["name"].startswith("pointer")
    assert not await page.evaluate("resonatord.views[0].presser.isActive")


async def test_a_browser_without_webgl_keeps_the_flat_map(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info(skin=True))
    page = await open_page()
    await fake.send("decoded", pressed(0.2e-3))
    await page.evaluate("""() => { const { prototype } = HTMLCanvasElement, { getContext } = prototype;
      prototype.getContext = function (kind, ...more) {
        return kind === "webgl2" ? null : getContext.call(this, kind, ...more);
      }; }""")
    await page.locator(".relief-switch").click()
    await expect(page.locator(".relief-note")).to_contain_text("WebGL 2")
    await expect(page.locator(".relief-switch")).not_to_be_checked()
    await expect(page.locator(SURFACE)).to_be_visible()


async def test_a_view_that_is_removed_while_the_relief_loads_has_none(fake: FakeLivePage, open_page: Open) -> None:
    page = await open_page()
    shown = """async () => { const [view] = resonatord.views, { relief } = view.surface; relief.switch.click();
      view.remove(), await import("./relief_scene.js"); return relief.isShown; }"""
    assert not await page.evaluate(shown)


async def test_error_against_the_truth_is_zero_where_the_map_is_right(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info(skin=True))
    page = await open_page()
    touch = {"id": 1, "site": 1, "position_m": [0, 0], "force_newton": [0.25, 0, 1], "radius_m": 0.0025}
    for force_newton in (1.0, 3.0):
        await fake.send("decoded", decoded(hertz(force_newton, 0.0025)))
        await fake.send_text(truth={"plate": "p", "t_ns": str(10**18), "contacts": [touch], "traction_pascal": None})
        await expect(page.locator("option[value=error]")).to_be_enabled()
        await page.select_option(".surface-panel select", "error")
        await drawn(page)
        shown = await colour(page, SURFACE, 0.0006, 0.0006)  # next to the marks of the truth
        is_white = np.abs(shown - WHITE).max() <= 3
        assert is_white if force_newton == 1.0 else shown[0] - shown[2] > 60  # too much is red


async def test_contacts_show_force_margin_events_and_truth(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info(skin=True))
    page = await open_page()
    slip = {"slip_margin": 0.21, "slip_margin_std": 0.04, "friction_coefficient": 0.5, "friction_coefficient_std": 0.02}
    moment = {"moment_newton_m": [1e-3, 2e-3, 3e-3], "moment_std_newton_m": [1e-6] * 3}
    touch = contact((0.3, -0.1, 1.25), shape="ellipse", **moment, **slip)
    await fake.send("contacts", header(status="ok", contacts=[touch]))
    true = touch | {"force_newton": [0.3, 0, 1.3], "radius_m": 0.002}
    await fake.send_text(truth={"plate": "p", "t_ns": "1", "contacts": [true]})
    await fake.send("contacts/event", header(event="incipient_slip", contact=touch))
    await expect(page.locator(".card .normal")).to_have_text("1.2500 ± 0.0030 N")
    await expect(page.locator(".card .true")).to_have_text("true 1.300 N, off by \u221250 mN")
    await expect(page.get_by_role("meter")).to_have_attribute("aria-valuenow", "0.21")
    await expect(page.locator(".gauge output")).to_contain_text("0.210 ± 0.040, begins to slip")
    await expect(page.locator(".card dl")).to_contain_text("1.000, 2.000, 3.000 mN m")
    await expect(page.locator(".card dl")).to_contain_text("Objectellipse")
    await expect(page.locator(".events li")).to_contain_text("Contact 7 begins to slip")
    unknown = touch | {"slip_margin": None, "slip_reason_code": "friction_unknown"}
    await fake.send("contacts", header(status="ok", seq=2, t_ns="0", contacts=[unknown]))  # before all truth
    await expect(page.locator(".gauge output")).to_have_text("not known: friction unknown")
    await expect(page.locator(".card .true")).to_be_empty()


async def test_health_shows_losses_latency_and_calibration(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info(calibration={"id": "a", "date": "2020-01-01", "expiry": "2021-01-01"}))
    page = await open_page()
    await send_states(fake, ONLINE)
    bins = {"forces": {"bounds_ms": [1.0, 2.0, 10.0], "counts": [5, 93, 2, 0]}}
    lost = {"link_gap": 3, "damaged": 40}
    await fake.send("health", header(frame_rate_hz=998.7, latency=bins, lost=lost, cpu_percent=21.0, rss_mb=92.0))
    await expect(page.locator(".summary")).to_contain_text("3 never arrived from the board, 40 arrived damaged")
    await page.locator(".health-panel summary").click()
    for text in ("≤ 2.0 ms for half, ≤ 10 ms for 99 %", "999 of 1000 /s", "drift not", "expired until 2021-01-01"):
        await expect(page.locator(".figures")).to_contain_text(text)


OFFLINE = {"state": "offline", "reason_code": "stopped"}
STALLED = {"state": "stalled", "reason_code": "decoder_hung"}


@pytest.mark.parametrize(
    ("states", "code"),
    [
        (ONLINE, "well"),
        ({}, "never_started"),
        (ONLINE | {"daemon": OFFLINE, "link": {"state": "stalled"}}, "clean_stop"),
        (ONLINE | {"daemon": OFFLINE | {"reason_code": "connection_lost", "since_t_ns": None}}, "crash"),
        (ONLINE | {"daemon": OFFLINE | {"reason_code": "recording_over"}}, "recording_over"),
        (ONLINE | {"daemon": {"state": "online", "connections": 2, "connected_t_ns": "1"}}, "broker_restarted"),
        (ONLINE | {"link": {"state": "waiting"}, "sensor": {"state": "waiting"}}, "cable_out"),
        (ONLINE | {"link": {"state": "stalled"}, "sensor": {"state": "waiting"}}, "board_hung"),
        (ONLINE | {"link": {"state": "online", "reason_code": "computer_busy"}}, "computer_busy"),
        (ONLINE | {"link": {"state": "stalled", "reason_code": "computer_busy"}}, "computer_busy"),
        (ONLINE | {"link": {"state": "online", "reason_code": "computer_busy"}, "sensor": STALLED}, "sensor_stalled"),
        (ONLINE | {"link": {"state": "online", "boot_count": 2}}, "board_rebooted"),
        (ONLINE | {"sensor": {"state": "drifting"}}, "sensor_drifting"),
        (ONLINE | {"sensor": {"state": "online", "reason_code": "sensor_suspect"}}, "sensor_suspect"),
    ],
)
async def test_situations_differ(fake: FakeLivePage, open_page: Open, states: dict[str, Any], code: str) -> None:
    await fake.send("info", info())
    await send_states(fake, states)
    page = await open_page()
    banner = page.locator(".situation")
    await expect(banner).to_have_attribute("data-situation", code)
    icon = await banner.locator("use").get_attribute("href")
    assert await page.locator(icon or "").count() == 1
    assert await banner.locator("strong").inner_text()
    for part, keys in states.items():
        await expect(page.locator(".states")).to_contain_text(f"{part} {keys['state']}")
    if states.get("daemon", {}).get("state") == "offline":  # what others last were is not counted on
        await expect(page.locator(".states li").nth(1)).to_contain_text("as last published")


@pytest.mark.parametrize(("skin", "selector"), [(False, PLATE), (True, SURFACE)])
async def test_mouse_presses_and_releases(fake: FakeLivePage, open_page: Open, skin: bool, selector: str) -> None:
    fake.hello["press"] = ["p"]
    codes = [{"site": 1, "f0_hz": [9.9e6] * 4, "full_load_hz": [9.91e6] * 4}]  # those of one tone for each corner
    await fake.send("info", info(skin=skin) | {"codes": [] if skin else codes})
    page = await open_page()
    await expect(page.locator(".press-panel")).to_be_visible()
    x, y = await place(page, selector, 0.002, -0.001)
    await page.mouse.move(x, y)
    await page.mouse.down()
    first, *_, last = await fake.until("press", 10)
    assert first["plate"] == "p"
    assert np.abs(np.array(first["position_m"]) - (0.002, -0.001)).max() < 1e-4
    assert 0 < first["force_newton"][2] < last["force_newton"][2] <= 10
    empty = await colour(page, selector, 0.0015, -0.0015)
    if skin:
        await fake.send("decoded", decoded(np.full((3, 32, 32), 4e4)))
    else:
        await expect(page.locator(".press-output")).to_contain_text("between sites")
        touched = {"site": 1, "force_newton": 9.0, "noise_newton": 0.1, "systematic_newton": 0, "status": "ok"}
        places = [{"site": 1, "position_m": [0.002, -0.001]}]
        await fake.send("info", info(outline_m=[[-0.01, -0.01], [0.01, 0.01]]) | {"sites": places})
        await fake.send("forces", header(status="ok", sites=[touched]))
    await drawn(page)
    assert (await colour(page, selector, 0.0015, -0.0015) != empty).any()
    await page.mouse.up()
    assert (await fake.until("release"))[0] == {"plate": "p", "name": first["name"]}


async def test_dragging_shears_until_friction_and_leaving_releases(fake: FakeLivePage, open_page: Open) -> None:
    fake.hello["press"] = ["p"]
    await fake.send("info", info(skin=True))
    page = await open_page()
    await expect(page.locator(".press-panel")).to_be_visible()
    start, far = await place(page, SURFACE, -0.006, 0), await place(page, SURFACE, 0.006, 0)
    await page.mouse.move(*start)
    await page.mouse.down()
    await fake.until("press", 3)
    await page.mouse.move(*far, steps=5)
    count = len(fake.asked("press"))
    presses = await fake.until("press", count + 5)
    forces = np.array([press["force_newton"] for press in presses])
    shear = np.hypot(forces[:, 0], forces[:, 1])
    assert shear.max() > 0.1
    assert (shear <= 0.5 * 1.021 * forces[:, 2]).all()
    assert presses[-1]["position_m"][0] > -0.005  # it slid
    await page.mouse.move(far[0] + 900, far[1])
    await fake.until("release")


async def test_keys_press_and_release(fake: FakeLivePage, open_page: Open) -> None:
    fake.hello["press"] = ["p"]
    await fake.send("info", info())
    page = await open_page()
    await expect(page.locator(".press-panel")).to_be_visible()
    await page.locator(PLATE).focus()
    for _ in range(2):
        await page.keyboard.press("ArrowRight")
    await page.keyboard.down("Space")
    press = (await fake.until("press", 2))[-1]
    assert press["position_m"] == pytest.approx([0.001, 0])
    await page.keyboard.up("Space")
    await fake.until("release")


async def test_recordings_play_seek_and_stand_side_by_side(fake: FakeLivePage, open_page: Open) -> None:
    marks = [{"t_s": 3.5, "label": "drop"}]
    fake.hello["sources"] = [{"source": s, "file": f"{s}.mcap", "duration_s": 60.0, "marks": marks} for s in "ab"]
    for source in "ab":
        await fake.send("info", info(), source=source)
    page = await open_page()
    await expect(page.locator(".view")).to_have_count(2)
    one = page.locator(".view").first
    position = {"source": "a", "t_s": 12.3, "playing": False, "speed": 1.0, "ended": False, "truncated": "cut off"}
    await fake.send_text(position=position)
    await expect(one.locator(".time")).to_have_text("12.3 of 60.0 s")
    await expect(one.locator(".truncated")).to_have_text("Incomplete: cut off")
    await fake.send("state/link", header(state="lost", reason_code="recording_over"), source="a")
    await expect(one.locator(".situation")).to_have_attribute("data-situation", "recording_over")
    await one.locator(".recording-panel select").select_option("2")
    await one.locator(".play").click()
    await fake.until("play", 4)
    assert {"source": "b", "playing": True, "speed": 2} in fake.asked("play")
    await one.get_by_role("button", name="3.5 s drop").click()
    assert await fake.until("seek", 2) == [{"source": s, "t_s": 3.5} for s in "ab"]
    await one.locator(".together").uncheck()
    await one.get_by_role("slider").fill("30")
    assert (await fake.until("seek", 3))[-1] == {"source": "a", "t_s": 30}


async def test_recordings_of_the_directory_are_opened_compared_and_closed(fake: FakeLivePage, open_page: Open) -> None:
    listed = [{"name": f"{name}.mcap", "bytes": 1_234_567, "modified_s": 1.7e9} for name in ("one", "two")]
    fake.answer = lambda _: {"ok": True, "recordings": listed, "omitted": 0}
    fake.hello |= {"sources": [], "directory": "recordings"}
    page = await open_page()
    await page.get_by_role("button", name="Open one.mcap").click()
    source = {"source": "a", "file": "one.mcap", "duration_s": None, "failure": "it is empty", "opening": 1}
    await fake.send_text(hello=fake.hello | {"sources": [source]})
    await expect(page.locator(".failure")).to_contain_text("it is empty")
    await expect(page.locator(".recording-panel input[type=range]")).to_be_hidden()
    await page.get_by_role("button", name="Compare with two.mcap").click()
    await fake.until("open", 2)
    await fake.send_text(hello=fake.hello | {"sources": [source | {"source": s, "opening": 2} for s in "ab"]})
    await expect(page.locator(".view")).to_have_count(2)
    await fake.disconnect()  # the server closes what was open
    assert await fake.until("open", 3) == [{"names": ["one.mcap"]}, *2 * [{"names": ["one.mcap", "two.mcap"]}]]


async def test_commands_that_both_permit(fake: FakeLivePage, open_page: Open) -> None:
    fake.hello["commands"] = ["tare", "start_recording", "mark"]
    fake.answer = lambda request: {"ok": False, "error": {"code": "not_untouched", "message": "sites are touched"}}
    await fake.send("info", info())
    page = await open_page()
    await expect(page.locator(".record")).to_be_disabled()  # the daemon does not list it
    await page.locator(".tare").click()
    await expect(page.locator(".command-panel output")).to_have_text("Refused: sites are touched")
    await page.locator("button.mark").click()
    await expect(page.locator(".command-panel output")).to_contain_text("Enter the text")
    await expect(page.get_by_label("Text of the mark")).to_be_focused()
    await page.get_by_label("Text of the mark").fill("here")
    await page.locator("button.mark").click()
    sent = [list(command.values()) for command in await fake.until("command", 2)]
    assert sent == [["p", "tare", {}], ["p", "mark", {"text": "here"}]]


async def test_connects_again_and_watches_again(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info())
    page = await open_page()
    watched = len(await fake.until("watch"))
    await fake.disconnect()
    await expect(page.locator(".situation")).to_contain_text("No connection to the page's server since")
    await fake.until("watch", watched + 1)
    await expect(page.locator(".situation")).to_have_attribute("data-situation", "never_started")
    gone = {"connected": False, "reason_code": "no_broker", "reason": "no answer", "since_t_ns": "1789000000000000000"}
    await fake.send_text(broker=gone)
    await expect(page.locator(".situation")).to_contain_text("No connection to the MQTT broker since")
    since = await page.evaluate("new Date(1789000000000).toLocaleTimeString([], { hour12: false })")
    await expect(page.locator(".situation")).to_contain_text(since)
    await expect(page.locator(".situation")).to_contain_text("no answer")
    await fake.send_text(broker={"connected": True, "reason_code": "connected", "reason": ""})
    await fake.send("info", b"")  # the broker has lost it
    await expect(page.get_by_text("No plate has published yet")).to_be_visible()


TONE = {"captured": "site", "site": 2, "frequency_hz": 10007900.0, "noise_hz": 0.04, "residual": -0.5}


def codes(count: int) -> list[dict[str, Any]]:
    places = enumerate(range(10_004_000, 10_004_000 + 4000 * count, 4000), 1)
    return [{"site": site, "f0_hz": [hertz] * 4, "full_load_hz": [hertz - 500] * 4} for site, hertz in places]


async def test_each_ladder_has_the_tone_and_its_site(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info(schema_version="2.1", codes=codes(2), pilot_hz=1.0012e7))
    page = await open_page()
    pilot = {"captured": "pilot", "site": None, "frequency_hz": 10012000.0, "noise_hz": 0.1, "residual": None}
    silent = dict.fromkeys(pilot) | {"captured": "none", "reason_code": "channels_silent"}
    odd = pilot | {"captured": "unidentified", "frequency_hz": 10006000.0}
    await fake.send("tones", header(status="ok", window_s=0.01, corners=[TONE, pilot, silent, odd]))
    await expect(page.locator(".corner-list li")).to_have_count(4)
    one, _, three, _ = await page.locator(".corner-list li").all_inner_texts()
    assert "10007900.000 ± 0.040 Hz, \u221210.0 ppm from the code of site 2; off the fitted force by \u22120.5" in one
    assert "channels silent" in three
    identified = await page.locator(".rung.identified").evaluate_all("all => all.map((rung) => rung.dataset.site)")
    assert identified == ["2", "pilot"]
    places = "all => all.map((mark) => new DOMMatrix(getComputedStyle(mark).transform).e)"
    marks = await page.locator(".ladder > g > .mark:visible").evaluate_all(places)
    width = await page.locator(".ladder").evaluate("svg => svg.clientWidth") - 2 * 14
    assert marks == pytest.approx([14 + width * (hertz - 3500) / 8500 for hertz in (7900, 12000, 6000)], abs=0.5)


ODD: list[tuple[str, Any]] = [
    *((path, {}) for path in ("info", "state/daemon", "state/sensor", "forces", "contacts", "health")),
    ("decoded/summary", {}),
    *((path, b"{") for path in ("info", "contacts", "decoded")),
    ("info", b"null"),
    ("decoded", decoded(np.zeros((3, 3)), traction_pascal=None, grid=None)),
    ("decoded", decoded(np.full((3, 32, 32), np.nan))),
    ("decoded", decoded(np.zeros((3, 7)))[:200]),
    ("decoded", decoded(np.zeros((3, 10_000)), grid=None)),
    ("forces", {"sites": [None, {"site": "x", "force_newton": "y"}, {"site": 1, "force_newton": -3}], "lost": None}),
    ("contacts", {"contacts": [{}, None, contact(3 * [None], position_m=[None, None], position_covariance_m2=None)]}),
    ("contacts/event", {"event": "unheard_of", "contact": None}),
    ("state/link", {"state": "unheard_of", "last_outage": {}, "new_key": 1}),
    ("info", info(skin=True, sites=10_000, schema_version="3.0")),
    ("decoded", decoded(np.ones((3, 10_000)), grid=None, displacement_m=array(1e-4 * np.ones((3, 10_000))))),
    ("decoded", decoded(np.ones((3, 9, 9)), displacement_m=array(np.full((3, 9, 9), np.nan)))),
    ("decoded", decoded(np.ones((3, 1, 1)), displacement_m=array(np.ones((3, 1, 1))))),
    ("info", info(sites=0, outline_m=None, transducers_m=[[None, 1]], force_max_newton=None, calibration=None)),
    ("info", b""),
    ("state/daemon", b""),
    ("no/such/topic", {}),
    ("info", info(codes=[None, {"site": 1, "f0_hz": [1, None]}, {"f0_hz": 4 * [1], "full_load_hz": 4 * [1]}])),
    ("tones", {"corners": [None, {"captured": "site", "site": 9, "frequency_hz": 1}, {"captured": "unheard_of"}]}),
]


@pytest.mark.parametrize("relief", [False, True])
async def test_nothing_throws(fake: FakeLivePage, open_page: Open, relief: bool) -> None:
    """Missing fields, null, NaN, messages cut off, plates that change: `open_page` asserts no error."""
    fake.hello["press"] = ["p"]
    page = await open_page()
    if relief:
        await show_relief(page)
    await fake.send("state/daemon", header(state="online"))
    for path, payload in ODD:
        await fake.send(path, payload)
        await drawn(page)
    await fake.send_text(truth={}, position=None, clients=None, unheard_of=1)
    await fake.send_text(truth={"plate": "p", "contacts": [{}]}, answer={"id": 99})
    await fake.send("info", info(), plate="other plate")
    await page.get_by_role("button", name="other plate").click()
    await drawn(page)
    await fake.until("watch", 2)


@pytest.mark.parametrize("skin", [False, True])
@pytest.mark.parametrize("scheme", ["light", "dark"])
async def test_phone_width_and_accessibility(fake: FakeLivePage, open_page: Open, skin: bool, scheme: str) -> None:
    """No horizontal scroll at 360 px, and no finding of axe."""
    fake.hello |= {"press": ["p"], "commands": ["tare"], "directory": 40 * "d"}
    fake.answer = lambda _: {"ok": True, "recordings": [{"name": 80 * "n", "bytes": 1, "modified_s": 0}]}
    await fake.send("info", info(skin=skin, link="serial:/dev/serial/by-id/" + 60 * "x", codes=codes(16)))
    await send_states(fake, ONLINE | {"sensor": {"state": "drifting", "reason": 200 * "y"}})
    page = await open_page(viewport={"width": 360, "height": 740}, color_scheme=scheme, has_touch=True, is_mobile=True)
    await expect(page.get_by_text("a finger")).to_be_visible()
    await page.locator("#library summary").click()
    await expect(page.locator("#library li")).to_be_visible()
    slip = {"slip_margin": 0.1, "slip_margin_std": 0.04} if skin else {}
    await fake.send("contacts", header(status="ambiguous", contacts=[contact((0.1, 0.2, 1.3), **slip)]))
    await fake.send("contacts/event", header(event="onset", contact=contact()))
    await fake.send("tones", header(status="ok", corners=[TONE] * 4))
    await expect(page.locator(".card")).to_be_visible()
    await expect(page.locator(".ladder .zoom:visible")).to_have_count(0 if skin else 4)
    if skin:
        await fake.send("decoded", pressed(0.2e-3))
        await show_relief(page)
        await expect(page.locator(".relief-labels .contact")).to_be_visible()
        await expect(page.locator(".relief-hint")).to_have_text("Two fingers turn it", use_inner_text=True)
    assert await page.evaluate("document.documentElement.scrollWidth") <= 360
    await page.evaluate(AXE.read_text())  # `make test-browser` installs it
    found = await page.evaluate("axe.run()")
    assert [(f["id"], [node["target"] for node in f["nodes"]]) for f in found["violations"]] == []


@pytest.mark.parametrize("skin", [False, True])
async def test_nothing_lies_below_the_fold(fake: FakeLivePage, open_page: Open, skin: bool) -> None:
    await fake.send("info", info(skin=skin, codes=codes(16)))
    await send_states(fake, ONLINE)
    page = await open_page(viewport={"width": 1400, "height": 900})
    await fake.send("contacts", header(status="ok", contacts=[contact((0.1, 0.2, 1.3), slip_margin=0.5)]))
    await expect(page.locator(".card")).to_be_visible()
    await expect(page.locator(".states")).to_be_hidden()  # nothing is wrong
    for selector in ("html", ".side", ".main"):
        assert await page.locator(selector).evaluate("it => it.scrollHeight - it.clientHeight") <= 0


async def test_page_weight_and_origin() -> None:
    files = [file for file in PAGE.rglob("*") if file.is_file()]
    at_once = [file for file in files if file.parent.name != "three"]  # which only the relief loads
    assert sum(file.stat().st_size for file in at_once) <= 300_000
    own = [file for file in files if file.parent == PAGE and file.suffix in (".html", ".js", ".css")]
    assert [file.name for file in own if "//cdn" in file.read_text() or "https://" in file.read_text()] == []


@pytest.mark.soak
async def test_memory_stays_flat_over_ten_minutes(fake: FakeLivePage, open_page: Open) -> None:
    await fake.send("info", info(skin=True))
    page = await open_page()
    session = await page.context.new_cdp_session(page)
    used: list[float] = []
    frame = decoded(hertz(1.0, 0.0025))
    for _minute in range(11):
        for _ in range(60 * 30):
            await fake.send("decoded", frame)
            await fake.send("contacts", header(status="ok", contacts=[contact((0.1, 0, 1), slip_margin=0.5)]))
            await page.wait_for_timeout(33)
        await session.send("HeapProfiler.collectGarbage")
        used.append((await session.send("Runtime.getHeapUsage"))["usedSize"])
    assert used[-1] <= used[1] + 1_000_000  # the first minute fills the history
