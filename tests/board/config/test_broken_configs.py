"""Mistakes that people make in a configuration: each message names the key and what to do."""

from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.values import plate_text
from resonator_daemon.daemon.service.config_store import load_checked

TOP = 'plate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'
SKIN = 'plate = "skin32"\nlink = "tcp://127.0.0.1:5000"\n'


def link(text: str) -> str:
    return f'plate = "quartz16"\nlink = {text}\n'


# What is wrong, the text, the line and key that a message names, and the words of its remedy.
BROKEN = [
    # What is no TOML.
    ("no quotes", "plate = quartz16\n" + link('"tcp://a:1"')[19:], ":1: ", "put text in quotes"),
    ("quote left open", 'plate = "quartz16\nlink = "tcp://a:1"\n', ":1: ", "close the quotes"),
    ("typographic quotes", "plate = “quartz16”\n", ":1: ", 'plain "'),
    ("colon for equals", 'plate: "quartz16"\n', ":1: ", "key = value"),
    ("value left out", TOP + "[measurement]\nwindow_ms =\n", ":4: ", "give a value"),
    ("key twice", TOP + 'plate = "skin32"\n', ":3: ", "once"),
    ("bracket left open", TOP + "[mqtt\n", ":3: ", "]"),
    ("list left open", TOP + '[commands]\nallow = ["tare"\nx = 1\n', ":5: ", "]"),
    ("python's true", TOP + "[recording]\nautostart = True\n", ":4: ", "true or false"),
    ("decimal comma", TOP + "[measurement]\nwindow_ms = 10,5\n", ":4: ", "decimal point"),
    ("number with a unit", TOP + "[measurement]\nwindow_ms = 10ms\n", ":4: ", "one key = value a line"),
    ("two keys a line", 'plate = "quartz16" link = "tcp://a:1"\n', ":1: ", "one key = value a line"),
    # Keys that are not there, or elsewhere.
    ("empty", "", "plate: missing", "name of a shipped plate"),
    ("no link", 'plate = "quartz16"\n', "link: missing", "resonatord ports"),
    ("misspelt key", TOP + 'nmae = "a"\n', ":3: nmae: unknown key", "did you mean name?"),
    ("in the wrong table", TOP + "[mqtt]\nwindow_ms = 10\n", ":4: mqtt.window_ms",
     "did you mean measurement.window_ms?"),
    ("name below a table", TOP + '[mqtt]\nname = "a"\n', ":4: mqtt.name", "did you mean name? It belongs above"),
    ("a foreign key", TOP + "threads = 4\n", ":3: threads: unknown key", "allowed: name, plate, link, mqtt"),
    ("table of tables", TOP + "[[mqtt]]\n", ":3: mqtt: got [a table]", "must be a table"),
    # Names.
    ("name with a slash", TOP + 'name = "left/index"\n', ":3: name: got 'left/index'", "no space, /, +, #"),
    ("name of decoders", TOP + 'name = "decoder"\n', ":3: name: got 'decoder'", "choose another"),
    ("name too long", TOP + f'name = "{"a" * 101}"\n', ":3: name: got 'aaa", "at most 100 characters"),
    # Plates.
    ("plate misspelt", TOP.replace("quartz16", "quarz16"), ":1: plate: got 'quarz16'", "did you mean quartz16?"),
    ("plate not there", TOP.replace("quartz16", "gone.toml"), ":1: plate: got 'gone.toml'", "allowed: comb16"),
    ("plate is damaged", TOP.replace("quartz16", "damaged.toml"), ":1: plate: got", "damaged.toml:1: not TOML"),
    ("plate of the future", TOP.replace("quartz16", "format2.toml"), "format: got 2", "must be 1"),
    ("codes that overlap", TOP.replace("quartz16", "twins.toml"), "board.toml: plate:", "counter.codes_may_overlap"),
    # Links.
    ("a path alone", link('"/dev/ttyACM0"'), ":2: link: got '/dev/ttyACM0'", "serial:/dev/ttyACM0?baud=4000000"),
    ("no baud", link('"serial:/dev/ttyACM0"'), ":2: link:", "serial:PATH?baud=N"),
    ("baud too low", link('"serial:/dev/ttyACM0?baud=115200"'), ":2: link:", "raise baud above 2040000"),
    ("baud twice", link('"serial:/dev/a?baud=4000000&baud=9600"'), ":2: link:", "baud is given twice"),
    ("scheme misspelt", link('"tcpip://127.0.0.1:5000"'), ":2: link:", "did you mean tcp?"),
    ("port out of range", link('"tcp://127.0.0.1:99999"'), ":2: link:", "port (1 to 65535)"),
    ("lsusb with 0x", link('"usb:0x1209:0x0001"'), ":2: link:", "four hexadecimal digits"),
    ("replay without a file", link('"replay:"'), ":2: link:", "must be replay:FILE"),
    ("replay of no file", link('"replay:gone.mcap"'), ":2: link: got 'replay:gone.mcap'", "no such file"),
    # The broker.
    ("no scheme", TOP + '[mqtt]\nurl = "127.0.0.1:1883"\n', ":4: mqtt.url: got '127.0.0.1:1883'", "mqtt://host:port"),
    ("name of no host", TOP + '[mqtt]\nurl = "mqtt://a..b"\n', ":4: mqtt.url: got 'mqtt://a..b'", "1 to 63"),
    ("hash in a password", TOP + '[mqtt]\nurl = "mqtt://me:pass#1@a"\n', ":4: mqtt.url:", "as %23"),
    # Times, sizes, words.
    ("window in seconds", TOP + "[measurement]\nwindow_ms = 0.01\n", ":4: measurement.window_ms: got 0.01",
     "near: 1 or 2"),
    ("unit in quotes", TOP + '[measurement]\nwindow_ms = "10 ms"\n', ":4: measurement.window_ms",
     "give it alone, as 10"),
    ("on for true", SKIN + '[decoding]\ncontact_physics = "on"\n', ":4: decoding.contact_physics: got 'on'",
     "true or false, without quotes"),
    ("a command alone", TOP + '[commands]\nallow = "tare"\n', ":4: commands.allow: got 'tare'", "as ['tare']"),
    ("budget below a file", TOP + "[recording]\nmax_total_mb = 100\n", ":4: recording.max_total_mb: got 100",
     "lower file_max_mb"),
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("broken")
    plate = load_plate("quartz16")
    good = plate_text(plate)
    first, second, *others = plate.sites
    twins = plate.model_copy(update={"sites": (first, second.model_copy(update={"tones": first.tones}), *others)})
    (folder / "damaged.toml").write_text("format 1\n")
    (folder / "format2.toml").write_text(good.replace("format = 1", "format = 2"))
    (folder / "twins.toml").write_text(plate_text(twins))
    return folder


@pytest.mark.parametrize(("text", "key", "remedy"), [case[1:] for case in BROKEN], ids=[case[0] for case in BROKEN])
def test_the_message_names_key_and_remedy(folder: Path, text: str, key: str, remedy: str) -> None:
    (folder / "board.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_checked(folder / "board.toml")
    told = "\n".join(caught.value.messages)
    assert [message for message in caught.value.messages if key in message and remedy in message], told
    assert all("\n" not in message for message in caught.value.messages)
