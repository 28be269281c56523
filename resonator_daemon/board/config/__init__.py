"""Models and checks of the configuration files: of a board, of a decoder, of a client."""

from resonator_daemon.board.config.board import (
    Client,
    Config,
    config_from,
    example_config,
    load_client,
    load_config,
    timing_problems,
)
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import (
    DECODER,
    Decoding,
    Listen,
    Measurement,
    Recording,
    parse_listen,
    plate_name,
)

__all__ = [
    "DECODER",
    "Client",
    "Config",
    "Decoding",
    "Listen",
    "Measurement",
    "Mqtt",
    "Recording",
    "config_from",
    "example_config",
    "load_client",
    "load_config",
    "parse_listen",
    "plate_name",
    "timing_problems",
]
