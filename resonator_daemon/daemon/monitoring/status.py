"""Status of a running daemon for programs on the same computer: its states, health, and configuration."""

from typing import Literal

from pydantic import Field

from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.mqtt.payloads import Health, Int64, Message, RecordingInfo, State


class ConfigChange(Message):
    """Key whose value in the file, when it was last read again, was another one than in use."""

    key: str = Field(description="as mqtt.url")
    old: str = Field(description="that was in use")
    new: str = Field(description="that the file has")
    applied: bool = Field(description="whether it is in use; else after a restart")


class ConfigStatus(Message):
    """Configuration that a daemon uses."""

    file: str = Field(description="that the daemon was started with, absolute")
    in_use: Literal["file", "last_good"] = Field(
        description="`file`: its content when it was last read without problems; `last_good`: a copy kept from an "
        "earlier run, because the file had problems at the start"
    )
    reason_code: ReasonCode | None = Field(
        None, description="why the file is not in use as it is: `bad_configuration`, `restart_needed`; null if it is"
    )
    problems: tuple[str, ...] = Field(
        (),
        description="of the file as it was last read, as `resonatord check` prints them; not empty: it is not in use",
    )
    loaded_t_ns: Int64 = Field(description="UTC, when what is in use was read")
    needs_restart: tuple[str, ...] = Field(
        (), description="keys that the file has changed and that have an effect after a restart only"
    )
    reloads: int = Field(0, description="how often the file was read again")
    changes: tuple[ConfigChange, ...] = Field((), description="by the last time that it was, where it could be used")


class BrokerStatus(Message):
    """Connection of a daemon to its broker."""

    url: str = Field(description="without user and password")
    connected: bool = Field(description="whether messages go out at present")


class Status(Message):
    """Status of one daemon."""

    name: str | None = Field(
        description="under which it publishes; null until the board has reported its serial number"
    )
    instance: str = Field(description="file name of the configuration, without its ending")
    pid: int = Field(description="of the daemon's process")
    version: str = Field(description="of resonatord")
    started_t_ns: Int64 = Field(description="UTC")
    config: ConfigStatus = Field(description="which configuration is in use")
    daemon: State | None = Field(description="as last published on `state/daemon`")
    link: State | None = Field(description="as last published on `state/link`")
    sensor: State | None = Field(description="as last published on `state/sensor`")
    health: Health | None = Field(description="as last made for `health`; null in the first second")
    broker: BrokerStatus = Field(description="how it stands with its broker")
    recording: RecordingInfo = Field(description="as in `health`")
    ages_s: dict[str, float] = Field(
        {},
        description="since the daemon `started`; since `config` in use was read, `daemon`, `link` and `sensor` are in "
        "their states, the last `outage` ended, the broker is `connected`, the `recording` began, each where there is "
        "such a moment; by the monotonic clock",
    )
