"""One message of each kind, as the tests of publishing send them: equal but for one number."""

from typing import Any

import numpy as np
import status_samples

from resonator_daemon.publishing.payloads import (
    BootInfo,
    CalibrationInfo,
    Compensation,
    Contact,
    Contacts,
    Decoded,
    DecodedSummary,
    DecoderHealth,
    DecoderPlateHealth,
    DecoderState,
    EventContact,
    Forces,
    Grid,
    GridInfo,
    Health,
    Info,
    LatencyInfo,
    Lost,
    Message,
    MessageAccount,
    Patch,
    Signals,
    SiteForce,
    SiteInfo,
    SkinInfo,
    State,
)
from resonator_daemon.publishing.payloads import ContactEvent as Event

HEADER: dict[str, Any] = {
    "seq": 1234,
    "daemon_boot_id": "9f3c",
    "board_boot_id": "51aa",
    "t_ns": 1789000000000000000,
    "t_unc_ns": 42000,
    "lost": Lost(),
}
COMPENSATION = Compensation(
    baseline="followed",
    common_mode=(3e-6,) * 4,
    common_mode_std=2e-7,
    plate_kelvin=0.5,
    plate_kelvin_std=0.1,
    response="off",
)
CONTACT: dict[str, Any] = {
    "site": 7,
    "position_m": (0.0012, -0.0034),
    "position_std_m": (2e-4, 2e-4),
    "position_correlation": 0.0,
    "force_newton": 1.234,
    "noise_newton": 0.0006,
    "systematic_newton": 0.012,
    "peak_newton": 1.3,
    "since_t_ns": 1788999990000000000,
    "duration_s": 0.35,
    "status": "ok",
}
ACCOUNT = MessageAccount(
    made=24010,
    restored=0,
    resent=0,
    recovered=0,
    acknowledged=22,
    handed_to_socket=23980,
    dropped={"no_connection": 6},
    unknown_at_disconnect=0,
    waiting=2,
    spooled=0,
)


class Messages:
    """Makes messages that differ by one number, `seq` and what tells it in an array."""

    @staticmethod
    def state(word: str, reason: str = "") -> State:
        return State(**HEADER, state=word, reason=reason, since_t_ns=1788999990000000000)

    @staticmethod
    def forces(number: int) -> Forces:
        site = SiteForce(site=7, force_newton=1.234, noise_newton=0.0006, systematic_newton=0.012, status="ok")
        return Forces(
            **_measured(number),
            window_s=0.01,
            status="ok",
            reason="",
            sites=(site,),
            beats=(),
            compensation=COMPENSATION,
        )

    @staticmethod
    def contacts(number: int) -> Contacts:
        return Contacts(**_measured(number), status="ok", contacts=(Contact(id=number, **CONTACT),))

    @staticmethod
    def event(number: int) -> Event:
        return Event(**_measured(number), event="onset", contact=EventContact(id=number, **CONTACT))

    @staticmethod
    def signals(number: int) -> Signals:
        array = np.full((3, 1024), number, np.float32)
        return Signals(**_measured(number), signals=array, noise_std=np.full((3, 1024), 1e-3), status="ok")

    @staticmethod
    def decoded(number: int) -> Decoded:
        array = np.full((3, 32, 32), number, np.float32)
        return Decoded(
            **_measured(number),
            traction_pascal=array,
            traction_std_pascal=array,
            displacement_m=None,
            grid=Grid(origin_m=(-0.0062, -0.0062), pitch_m=4e-4),
        )

    @staticmethod
    def summary(number: int) -> DecodedSummary:
        patch = Patch(
            id=number,
            centroid_m=(0.0012, -0.0034),
            centroid_std_m=(1e-5, 1e-5),
            area_m2=1.9e-5,
            force_newton=(0.41, 0.0, 1.02),
            force_std_newton=(0.002, 0.002, 0.003),
            moment_newton_m=(-0.0035, -0.0012, 0.0014),
            moment_std_newton_m=(1e-5, 1e-5, 1e-5),
            at_border=False,
            radius_of_curvature_m=0.0056,
            stick_ratio=0.58,
            slip_margin=0.2,
            slip_margin_std=0.01,
            friction_coefficient=0.5,
            friction_coefficient_std=0.015,
            slip_reason="",
        )
        return DecodedSummary(
            **_measured(number),
            decoder="open-plane+contact",
            chi2=1.02,
            border_contact=False,
            status="ok",
            reason="",
            patches=(patch,),
        )

    @staticmethod
    def info(number: int) -> Info:
        return Info(
            **HEADER | {"seq": number},
            schema_version="1.0",
            daemon_version="0.1.0",
            plate="skin32",
            link="serial:/dev/ttyACM0?baud=4000000",
            product="resonator board",
            serial_number="0042",
            firmware="1.2.0",
            counter="channelised",
            frame_rate_hz=100.0,
            window_s=0.01,
            step_s=0.01,
            rates_hz={"signals": 100.0},
            units={"newton": "N"},
            commands=("ping",),
            force_max_newton=10.0,
            outline_m=((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01)),
            transducers_m=((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01)),
            sites=(SiteInfo(site=1, position_m=(-0.0061, 0.0042)),),
            grid=GridInfo(origin_m=(-0.0062, -0.0062), pitch_m=4e-4, shape=(1, 1)),
            skin=SkinInfo(
                youngs_modulus_pascal=2e5,
                poisson_ratio=0.5,
                depth_m=1e-3,
                gain_std=0.01,
                correlation_length_m=2e-3,
                tangential_ratio=0.5,
            ),
            calibration=CalibrationInfo(
                id=None, date=None, unit=None, expiry=None, model_error=0.01, sensitivity_std=0.001, response="off"
            ),
        )

    @staticmethod
    def health(number: int) -> Health:
        return Health(
            **HEADER | {"seq": number},
            uptime_s=60.2,
            frames=6000,
            frame_rate_hz=100.0,
            parts_lost=0,
            frames_not_decoded=0,
            records_unusable={},
            packets_ignored={"stale": 0},
            bytes_in=12240312,
            bytes_by_fate={"accepted": 12240312},
            connections=1,
            host_overruns=0,
            boots=(BootInfo(board_boot_id="51aa", connections=1, frames=6000, lost={"link_gap": 0}),),
            clock_drift_ppm=3.1,
            clock_outliers=0,
            clock_restarts=0,
            cpu_percent=21.0,
            rss_mb=92.0,
            tasks=9,
            threads=4,
            file_descriptors=23,
            latency={"signals": LatencyInfo(bounds_ms=(1.0, 2.0), counts=(5000, 990, 10))},
            recording=status_samples.NOT_RECORDING,
            messages=ACCOUNT,
        )

    @staticmethod
    def decoder_state(word: str, reason: str = "") -> DecoderState:
        return DecoderState(
            decoder_id="host-1",
            state=word,
            reason=reason,
            t_ns=1789000000000000000,
            since_t_ns=1788999990000000000,
            topic_filter="resonator/left/signals",
        )

    @staticmethod
    def decoder_health(number: int) -> DecoderHealth:
        plate = DecoderPlateHealth(received=number, decoded=number, skipped=0, unusable=0, waiting=0, missed=0)
        return DecoderHealth(
            decoder_id="host-1",
            t_ns=1789000000000000000,
            uptime_s=60.2,
            plates={"left": plate},
            cpu_percent=40.0,
            rss_mb=130.0,
            latency={"decoded": LatencyInfo(bounds_ms=(1.0, 2.0), counts=(5000, 990, 10))},
            messages=ACCOUNT,
        )

    @staticmethod
    def by_path() -> dict[str, Message]:
        """Return one message for each topic below `prefix/name/`."""
        return {
            "state/daemon": Messages.state("online"),
            "state/link": Messages.state("waiting", "no such port"),
            "state/sensor": Messages.state("drifting", "warm"),
            "info": Messages.info(1),
            "contacts/event": Messages.event(2),
            "forces": Messages.forces(3),
            "contacts": Messages.contacts(4),
            "signals": Messages.signals(5),
            "decoded": Messages.decoded(6),
            "decoded/summary": Messages.summary(7),
            "health": Messages.health(8),
        }


def _measured(number: int) -> dict[str, Any]:
    return HEADER | {"seq": number, "board_ticks": 1}
