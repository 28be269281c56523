"""Configuration: the example passes, and every mistake is told with its line, key, value, limit and remedy."""

from pathlib import Path

import pytest
from config_files import loaded, refusals
from hypothesis import given, settings
from hypothesis import strategies as st
from plates import plate_head, site

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.board.config import example_config, load_config
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.links.carriers.recording import RecordingTarget
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.carriers.tcp import TcpTarget
from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.board.links.target import LinkTarget

MINIMAL = 'plate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'

SLOW_PLATE = plate_head("slow", (-1, -1), (1, 1), 1, reference_hz=1e9, frame_rate_hz=250, pilot_hz=10.01e6) + site(
    1, 0, 0, force=(9e6, -6e-6)
)


def test_the_example_passes_and_means_what_is_meant_without_it(tmp_path: Path) -> None:
    config = loaded(tmp_path, example_config())
    assert config.name == "left-index"
    assert config.plate.name == "quartz16"
    assert config.link == SerialTarget("/dev/serial/by-id/usb-RD_board_0042-if00", 4_000_000)
    assert (config.mqtt.host, config.mqtt.port, config.mqtt.prefix) == ("127.0.0.1", 1883, "resonator")
    assert (config.mqtt.username, config.mqtt.password) == (None, None)
    given = {"name": "a", "plate": "skin32", "link": "tcp://h:1", "url": "mqtt://b:2"}
    other = loaded(tmp_path, example_config(given))
    assert [other.name, other.plate.name, str(other.link), other.mqtt.url] == [*given.values()]
    assert config.measurement.window_s == pytest.approx(0.01)
    assert config.measurement.step_s == pytest.approx(0.005)
    assert (config.decoding.method, config.decoding.contact_physics) == ("open-plane", True)
    assert config.decoding.friction_coefficient is None
    short = loaded(tmp_path, MINIMAL)
    assert (short.name, short.link) == (None, TcpTarget("127.0.0.1", 5000))
    assert (short.mqtt, short.measurement, short.decoding) == (config.mqtt, config.measurement, config.decoding)


FOURIER = MINIMAL + '[decoding]\nmethod = "fourier"\n'


def test_the_fourier_decoder_is_refused_on_scattered_sites_alone(tmp_path: Path) -> None:
    assert len(refusals(tmp_path, FOURIER.replace("quartz16", "fingertip400") + "contact_physics = 1\n")) == 2
    for served in (FOURIER, FOURIER.replace("quartz16", "skin32"), MINIMAL.replace("quartz16", "fingertip400")):
        loaded(tmp_path, served)


@pytest.mark.parametrize(
    ("text", "link"),
    [
        ("serial:/dev/ttyACM0?baud=115200", SerialTarget("/dev/ttyACM0", 115200)),
        ("tcp://plate.example:5000", TcpTarget("plate.example", 5000)),
        ("tcp://[::1]:5000", TcpTarget("::1", 5000)),
        ("usb:1209:0001", UsbTarget(0x1209, 1, None)),
        ("usb:1209:00ff?serial=0042", UsbTarget(0x1209, 0xFF, "0042")),
        ("usb:1209:0001?serial=A%20%26%20B", UsbTarget(0x1209, 1, "A & B")),
        ("usb:abcd:ef01", UsbTarget(0xABCD, 0xEF01, None)),
        ("replay:/var/tmp/a run.mcap?", RecordingTarget("/var/tmp/a run.mcap?")),
    ],
)
def test_a_link_reads_as_it_is_written(text: str, link: LinkTarget) -> None:
    assert parse_link(text) == link
    assert str(link) == text


def test_every_mistake_comes_at_once(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        SLOW_PLATE.replace("id = 1", "id = 0").replace("9000000.0, 9000000.0]", "-9000000.0, 9000000.0]")
    )
    text = (
        'name = "a b"\nplate = "mine.toml"\nlink = "usb:1"\n'
        "[measurement]\nwindow_mz = 10\nwindow_ms = 3\nstep_ms = 4\n"
        '[decoding]\nmethod = "of"\n'
    )
    mine = tmp_path / "mine.toml"
    expected = [
        "1: name: got 'a b'",
        f"2: plate: got 'mine.toml'; {mine}:12: sites[0].id: got 0",
        f"2: plate: got 'mine.toml'; {mine}:16: sites[0].tones[0].f0_hz[2]: got -9000000.0",
        "3: link: got 'usb:1'",
        "5: measurement.window_mz: unknown key",
        "7: measurement.step_ms: got 4; must be at most window_ms = 3",
        "9: decoding.method: got 'of'; allowed: open-plane, fourier, off; did you mean off?",
    ]
    for message, start in zip(refusals(tmp_path, text), expected, strict=True):
        assert message.startswith(start)


def test_windows_follow_the_plates_frames(tmp_path: Path) -> None:
    (tmp_path / "slow.toml").write_text(SLOW_PLATE)
    slow = MINIMAL.replace("quartz16", "slow.toml")
    step, window = refusals(tmp_path, slow + "[measurement]\nwindow_ms = 10\n")
    for message, place, near in ((window, "4: measurement.window_ms: got 10;", "8 or 12"), (step, "3: ", "4 or 8")):
        assert message.startswith(place)
        assert message.endswith(f"near: {near}")
    assert loaded(tmp_path, slow + "[measurement]\nwindow_ms = 12\nstep_ms = 4\n").measurement.window_ms == 12
    # the defaults are checked as well
    assert len(refusals(tmp_path, slow)) == 2
    # a value of the wrong type does not hide its neighbour's
    assert len(refusals(tmp_path, slow + '[measurement]\nwindow_ms = "x"\nstep_ms = 5\n')) == 2


def test_a_serial_line_must_carry_the_frames(tmp_path: Path) -> None:
    """4 records of 44 bytes in a packet of 28: 204 bytes of 10 bits, 1000 times a second, are 2.04 Mbit/s."""
    serial = 'plate = "quartz16"\nlink = "serial:/dev/x?baud={}"\n'
    (message,) = refusals(tmp_path, serial.format(2_000_000))
    for part in ("1000 frames/s", "204 bytes", "2040000 bit/s", "2000000 baud", "the highest that fits is 980 Hz"):
        assert part in message
    assert "the highest that fits is 999 Hz" in refusals(tmp_path, serial.format(2_040_000))[0]
    assert loaded(tmp_path, serial.format(2_040_001)).link == SerialTarget("/dev/x", 2_040_001)


PRINTABLE = st.characters(codec="utf-8", exclude_categories=["Cc"], exclude_characters='"\\')
VALUES = st.one_of(
    st.sampled_from(
        ['"x"', "true", "nan", "inf", "-0.0", "1e308", "9" * 400, "[]", "{}", "[[1, 2], 3]", "1979-05-27", '""']
    ),
    st.integers(-20, 2000).map(str),
    st.floats().map(lambda number: repr(float(number))),
    st.text(PRINTABLE, max_size=8).map(lambda text: f'"{text}"'),
)


@settings(max_examples=120)
@given(changes=st.dictionaries(st.integers(0, 11), VALUES, min_size=1, max_size=4))
def test_whatever_value_a_key_gets(tmp_path_factory: pytest.TempPathFactory, changes: dict[int, str]) -> None:
    lines = example_config().splitlines()
    for number, value in changes.items():
        key, equals, _ = lines[number].partition(" = ")
        if equals:
            lines[number] = f"{key} = {value}"
    path = tmp_path_factory.getbasetemp() / "changed.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    try:
        config = load_config(path)
    except ConfigurationError as error:
        messages = error.messages
    else:
        messages = ()
        assert 0 < config.measurement.step_ms <= config.measurement.window_ms <= 1000
    assert all(message.startswith(f"{path}:") and "\n" not in message for message in messages)
