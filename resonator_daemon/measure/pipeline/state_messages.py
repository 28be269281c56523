"""Messages about the state of daemon, link and sensor, and about what the plate is."""

from collections.abc import Collection
from dataclasses import asdict
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.board.session.frames import BoardOnline, LinkChange, Outage
from resonator_daemon.estimate.forces.readings import Compensation as AppliedCompensation
from resonator_daemon.measure.sensors.base import Sensor
from resonator_daemon.mqtt import payloads
from resonator_daemon.mqtt.payload_types import UNITS
from resonator_daemon.mqtt.topics import INFO, SCHEMA_VERSION, STATE_LINK, STATE_SENSOR, Headers, Topic
from resonator_daemon.mqtt.verbs import permitted

_VERSION: Final = version("resonatord")  # of this process; an upgrade replaces the file that has it


class StateMessages:
    """Makes the messages about states.

    Parameters
    ----------
    config
    sensor
        Whose windows and streams `info` describes.
    headers
        Makes the headers.

    Attributes
    ----------
    allowed
        Commands that are accepted.
    """

    def __init__(self, config: Config, sensor: Sensor[Any], headers: Headers) -> None:
        self._plate = config.plate
        self._link = str(config.link)
        self._sensor = sensor
        self._headers = headers
        self.allowed: Collection[str] = config.commands.allow
        self._last_ns: dict[Topic[payloads.State], tuple[int, int]] = {}

    def link_state(self, link: LinkChange, outage: Outage | None, boot_count: int) -> payloads.State:
        """Return the link's state, with its last outage and the number of boots of the board."""
        last_outage = None
        if outage is not None:
            last_outage = payloads.OutageInfo(
                start_t_ns=outage.start_utc_ns,
                end_t_ns=outage.end_utc_ns,
                frames_lost=outage.frames_lost,
                reason_code=outage.reason.code,
                reason=outage.reason.text,
            )
        return payloads.State(
            **self._in_order(STATE_LINK, link.utc_ns, link.since_utc_ns),
            state=payloads.Condition(link.state),
            reason_code=link.reason.code,
            reason=link.reason.text,
            last_outage=last_outage,
            boot_count=boot_count,
        )

    def sensor_state(
        self,
        condition: payloads.Condition,
        reason: Reason,
        since_utc_ns: int,
        utc_ns: int,
        compensation: AppliedCompensation | None,
    ) -> payloads.State:
        return payloads.State(
            **self._in_order(STATE_SENSOR, utc_ns, since_utc_ns),
            state=condition,
            reason_code=reason.code,
            reason=reason.text,
            compensation=payloads.Compensation(**asdict(compensation)) if compensation is not None else None,
            suspect_sites=self._sensor.suspect_sites if reason.code is ReasonCode.SENSOR_SUSPECT else None,
        )

    def _in_order(self, topic: Topic[payloads.State], utc_ns: int, since_utc_ns: int) -> dict[str, Any]:
        """Return header and `since_t_ns` of a state, neither earlier than in the message before.

        A state that frames show bears the time of their gates, one that their absence shows that of the host.
        """
        last_ns, last_since_ns = self._last_ns.get(topic, (utc_ns, since_utc_ns))
        t_ns, since_t_ns = max(utc_ns, last_ns), max(since_utc_ns, last_since_ns)
        self._last_ns[topic] = t_ns, since_t_ns
        return {**self._headers.of(topic, t_ns), "since_t_ns": since_t_ns}

    def info(self, board: BoardOnline, utc_ns: int) -> payloads.Info:
        """Return what the plate is."""
        plate = self._plate
        return payloads.Info(
            **self._headers.of(INFO, utc_ns),
            schema_version=SCHEMA_VERSION,
            daemon_version=_VERSION,
            plate=plate.name,
            link=self._link,
            product=board.identity.product,
            serial_number=board.identity.serial_number,
            firmware=board.identity.firmware,
            counter=plate.counter.kind,
            frame_rate_hz=plate.counter.frame_rate_hz,
            window_s=self._sensor.window_s,
            step_s=self._sensor.step_s,
            rates_hz=self._rates_hz(),
            units=UNITS,
            commands=permitted(self.allowed),
            force_max_newton=plate.force_max_newton,
            outline_m=_pairs(plate.outline_m),
            transducers_m=_pairs(plate.transducers_m),
            sites=tuple(
                payloads.SiteInfo(site=int(site), position_m=position)
                for site, position in zip(plate.site_ids, _pairs(plate.site_positions_m), strict=True)
            ),
            grid=self._grid(),
            skin=plate.skin and payloads.SkinInfo.model_validate(plate.skin, from_attributes=True),
            calibration=payloads.CalibrationInfo(
                **plate.calibration.model_dump(mode="json"), response="on" if plate.response else "off"
            ),
            codes=self._sensor.site_codes,
            pilot_hz=self._sensor.pilot_hz,
        )

    def _rates_hz(self) -> dict[str, float]:
        rate_hz = self._sensor.rate_hz
        rates_hz = {}
        for topic in self._sensor.streams:
            rates_hz[topic.path] = rate_hz if topic.rate_max_hz is None else min(rate_hz, topic.rate_max_hz)
            if topic.slow_hz is not None:
                rates_hz[topic.slow_path] = min(rate_hz, topic.slow_hz)
        return rates_hz

    def _grid(self) -> payloads.GridInfo | None:
        grid = self._plate.grid
        if grid is None:
            return None
        origin_m, *_ = _pairs(self._plate.site_positions_m)
        return payloads.GridInfo(origin_m=origin_m, pitch_m=grid.pitch_m, shape=grid.shape)


def _pairs(positions_m: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in positions_m)
