"""Models and checks of the configuration files: of a board, of a decoder, of a client."""

from resonator_daemon.config.board import (
    Client,
    Config,
    config_from,
    example_config,
    load_client,
    load_config,
    timing_problems,
)
from resonator_daemon.config.link_targets import LinkTarget, ReplayLink, SerialLink, TcpLink, UsbLink, parse_link
from resonator_daemon.config.mqtt import Mqtt
from resonator_daemon.config.tables import DECODER, Decoding, Listen, Measurement, Recording, plate_name

__all__ = [
    "DECODER",
    "Client",
    "Config",
    "Decoding",
    "LinkTarget",
    "Listen",
    "Measurement",
    "Mqtt",
    "Recording",
    "ReplayLink",
    "SerialLink",
    "TcpLink",
    "UsbLink",
    "config_from",
    "example_config",
    "load_client",
    "load_config",
    "parse_link",
    "plate_name",
    "timing_problems",
]
