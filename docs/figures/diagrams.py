"""Draw the diagrams of the documentation: system, plate, states of link and sensor, calibration set-up.

Run it with `make figures`, or `python docs/figures/diagrams.py`.
"""

from pathlib import Path

from svg import Drawing

from resonator_daemon.base.plate import load_plate

FOLDER = Path(__file__).parent
PIXELS_PER_MM = 22.0


def system() -> Drawing:
    """Draw plate, board, computer, broker and subscribers."""
    drawing = Drawing(980, 250)
    boxes = {
        80: "plate\nsites; transducers\nin the corners",
        280: "counter board\nfrequencies of\nfour channels",
        500: "computer\nresonatord run\none daemon a plate",
        700: "MQTT broker\nsuch as Mosquitto",
        900: "subscribers\ngripper, log,\nresonatord watch",
    }
    for x, lines in boxes.items():
        drawing.box((x, 90), (140, 90), lines)
    for left, right, words in (
        (150, 210, "tones"),
        (350, 430, "frames"),
        (570, 630, "messages"),
        (770, 830, "messages"),
    ):
        drawing.path(f"M{left} 90 H{right - 4}")
        drawing.text((left + right) / 2, 80, words, "note")
    drawing.text(390, 112, "serial, USB", "note")
    drawing.text(390, 128, "or TCP", "note")
    drawing.box((700, 210), (200, 50), "resonatord decode\noptional: surface of a skin")
    drawing.path("M680 135 V181")
    drawing.path("M720 185 V139")
    drawing.text(672, 164, "signals", "note", "end")
    drawing.text(728, 164, "decoded", "note", "start")
    drawing.box((390, 210), (230, 50), "resonatord emulate\nreplaces plate and board")
    drawing.path("M390 185 V139")
    return drawing


def plate() -> Drawing:
    """Draw quartz16 as its plate file has it: axes, sites with their numbers, transducers."""
    quartz = load_plate("quartz16")
    drawing = Drawing(640, 560)

    def at(x_mm: float, y_mm: float) -> tuple[float, float]:
        return 300 + PIXELS_PER_MM * x_mm, 270 + PIXELS_PER_MM * y_mm

    corners = [at(*(1e3 * corner)) for corner in quartz.outline_m]
    drawing.path("M" + " L".join(f"{x:g} {y:g}" for x, y in corners) + " Z", "box")
    x, y = at(0, 0)
    drawing.path(f"M{x} {y} h62")
    drawing.path(f"M{x} {y} v62")
    drawing.text(x + 72, y + 5, "x", "title")
    drawing.text(x, y + 80, "y", "title")
    drawing.circle(x, y, 3, "box")
    drawing.text(x - 8, y - 8, "0, 0", "note", "end")
    for channel, corner in enumerate(quartz.transducers_mm):
        x, y = at(*corner)
        drawing.circle(x, y, 12, "bad")
        drawing.text(x, y + 5, str(channel))
    for number, place in zip(quartz.site_ids, quartz.site_positions_m, strict=True):
        x, y = at(*(1e3 * place))
        drawing.circle(x, y, 13, "good")
        drawing.text(x, y + 5, str(number))
    drawing.text(300, 530, "quartz16, seen from the touched side; z leads into the plate. 20 mm wide", "note")
    drawing.text(300, 548, "green: sites with their numbers; orange: transducers with their channels", "note")
    return drawing


def link_states() -> Drawing:
    """Draw the states of `state/link`."""
    drawing = Drawing(980, 400)
    size = (150, 56)
    drawing.box((130, 90), size, "waiting\nno port, no host")
    drawing.box((420, 90), size, "starting\nboard is configured")
    drawing.box((740, 90), size, "online\nframes come", "good")
    drawing.box((740, 300), size, "stalled\nnothing usable comes", "bad")
    drawing.box((420, 300), size, "lost\nwas there", "bad")
    drawing.box((130, 300), size, "refused\nanother board", "bad")
    drawing.path("M205 80 H339")
    drawing.text(272, 70, "the port opens", "note")
    drawing.path("M345 102 H211")
    drawing.text(278, 120, "it cannot be opened", "note")
    drawing.path("M495 90 H659")
    drawing.text(577, 80, "first frame", "note")
    drawing.path("M720 118 V266")
    drawing.text(712, 214, "silent for three", "note", "end")
    drawing.text(712, 230, "gates and 50 ms", "note", "end")
    drawing.path("M760 272 V124")
    drawing.text(768, 198, "frames again", "note", "start")
    drawing.path("M665 300 H501")
    drawing.text(583, 290, "silent for 3 s,", "note")
    drawing.text(583, 320, "or the link breaks", "note")
    drawing.path("M668 114 L499 268")
    drawing.text(560, 172, "unplugged,", "note", "end")
    drawing.text(560, 188, "restarted", "note", "end")
    drawing.path("M420 272 V124")
    drawing.text(412, 190, "the board answers", "note", "end")
    drawing.path("M352 118 L192 268")
    drawing.text(250, 190, "it cannot serve", "note", "end")
    drawing.text(244, 206, "the configuration", "note", "end")
    drawing.path("M110 272 V124")
    drawing.text(102, 190, "tried again", "note", "end")
    return drawing


def sensor_states() -> Drawing:
    """Draw the states of `state/sensor`."""
    drawing = Drawing(980, 330)
    size = (170, 56)
    drawing.box((120, 150), size, "waiting\nno frames")
    drawing.box((370, 150), size, "starting\nplate or decoder not ready")
    drawing.box((640, 150), size, "online\nnothing is wrong", "good")
    drawing.box((370, 40), size, "pressed_at_start\nrelease the plate", "bad")
    drawing.box((880, 50), size, "drifting\nlet the plate warm up", "bad")
    drawing.box((880, 150), size, "stalled\nno tone, or no decoder", "bad")
    drawing.box((880, 250), size, "uncalibrated\ncalibrate again", "bad")
    drawing.path("M205 150 H279")
    drawing.text(242, 140, "frames", "note")
    drawing.path("M455 150 H549")
    drawing.text(502, 140, "ready", "note")
    drawing.path("M370 122 V74")
    drawing.text(362, 104, "touched", "note", "end")
    drawing.path("M455 50 L590 120")
    drawing.text(535, 78, "untouched", "note", "start")
    for y, there in ((50, "M700 122 L789 62"), (150, "M725 142 H789"), (250, "M700 178 L789 238")):
        drawing.path(there)
        drawing.path({50: "M795 74 L722 126", 150: "M795 158 H731", 250: "M795 226 L722 174"}[y])
    drawing.path("M640 178 V290 H120 V184")
    drawing.text(380, 282, "no frames for half a second (from each state)", "note")
    return drawing


def calibration() -> Drawing:
    """Draw the set-up of a calibration with masses."""
    drawing = Drawing(760, 330)
    drawing.box((230, 70), (90, 80), "mass\n50 to 500 g")
    drawing.path("M230 110 V158", "line")
    drawing.text(246, 140, "on one site at a time", "note", "start")
    drawing.path("M60 160 H400 V184 H60 Z", "box")
    drawing.text(230, 177, "plate", "note")
    for x in (80, 380):
        drawing.path(f"M{x} 184 V250", "line")
    drawing.path("M20 250 H440", "line")
    drawing.text(230, 270, "nothing else touches the plate", "note")
    drawing.box((560, 172), (170, 60), "counter board\nits daemon is stopped")
    drawing.path("M400 172 H471")
    drawing.box((560, 290), (250, 56), "resonatord calibrate\nnames site and mass of each step")
    drawing.path("M560 202 V258")
    drawing.box((640, 60), (180, 56), "thermometer\noptional: --kelvin")
    return drawing


def main() -> None:
    for draw in (system, plate, link_states, sensor_states, calibration):
        draw().save(FOLDER / f"{draw.__name__.replace('_', '-')}.svg")


if __name__ == "__main__":
    main()
