"""Messages made by hand, as a plate could publish them."""

import math
from typing import Any

import numpy as np
import status_samples
from numpy.typing import NDArray

from resonator_daemon.publishing.payloads import (
    CalibrationInfo,
    Compensation,
    Contact,
    Contacts,
    Decoded,
    DecodedSummary,
    Forces,
    Grid,
    Health,
    Info,
    Lost,
    MessageAccount,
    Patch,
    SiteForce,
    SiteInfo,
    State,
    Status,
)

NOW_NS = 1_789_000_000_000_000_000
S = 1_000_000_000


def header(**changes: Any) -> dict[str, Any]:
    fields = {"seq": 1, "daemon_boot_id": "9f3c", "board_boot_id": "51aa", "t_ns": NOW_NS, "t_unc_ns": 42_000}
    return {**fields, "lost": Lost(), **changes}


def state(word: str, reason: str = "", since_s_ago: float = 10.0, **changes: Any) -> State:
    since_t_ns = NOW_NS - round(since_s_ago * S)
    return State(**header(**changes), state=word, reason=reason, since_t_ns=since_t_ns)


def info(sites: dict[int, tuple[float, float]], **changes: Any) -> Info:
    return Info(
        **header(**changes),
        schema_version="1.0",
        daemon_version="0.1.0",
        plate="quartz16",
        link="tcp://127.0.0.1:5555",
        product="board",
        serial_number="EMU-0001",
        firmware="1.2.0",
        counter="single-tone",
        frame_rate_hz=1000.0,
        window_s=0.01,
        step_s=0.005,
        rates_hz={},
        units={},
        commands=(),
        force_max_newton=10.0,
        outline_m=((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01)),
        transducers_m=(),
        sites=tuple(SiteInfo(site=site, position_m=position) for site, position in sites.items()),
        grid=None,
        skin=None,
        calibration=CalibrationInfo(
            id=None, date=None, unit=None, expiry=None, model_error=0.015, sensitivity_std=0.0, response="off"
        ),
    )


def site_force(site: int, force_newton: float, **changes: Any) -> SiteForce:
    fields = {"force_newton": force_newton, "noise_newton": 0.0006, "systematic_newton": 0.012, "status": "ok"}
    return SiteForce(site=site, **{**fields, **changes})


def forces(*sites: SiteForce, status: str = "ok", **changes: Any) -> Forces:
    compensation = Compensation(
        baseline="followed",
        common_mode=(0.0,) * 4,
        common_mode_std=2e-7,
        plate_kelvin=math.nan,
        plate_kelvin_std=math.nan,
        response="off",
    )
    return Forces(
        **header(**changes),
        board_ticks=1,
        window_s=0.01,
        status=status,
        reason="",
        sites=sites,
        beats=(),
        compensation=compensation,
    )


def contacts(site: int, force_newton: float, since_s_ago: float) -> Contacts:
    contact = Contact(
        id=12,
        site=site,
        position_m=(0.0, 0.0),
        position_std_m=(1e-3, 1e-3),
        position_correlation=0.0,
        force_newton=force_newton,
        noise_newton=0.0006,
        systematic_newton=0.012,
        peak_newton=force_newton,
        since_t_ns=NOW_NS - round(since_s_ago * S),
        duration_s=since_s_ago,
        status=Status.OK,
    )
    return Contacts(**header(), board_ticks=1, status="ok", contacts=(contact,))


def health(**changes: Any) -> Health:
    nothing: dict[str, Any] = {**dict.fromkeys(MessageAccount.model_fields, 0), "dropped": {}}
    fields = {
        "uptime_s": 100.0,
        "frames": 100_000,
        "frame_rate_hz": 1000.04,
        "parts_lost": 0,
        "frames_not_decoded": 0,
        "records_unusable": {},
        "packets_ignored": {"stale": 0, "malformed": 0, "unknown": 0},
        "bytes_in": 1,
        "bytes_by_fate": {"accepted": 1},
        "clock_drift_ppm": 1.5,
        "cpu_percent": 21.4,
        "rss_mb": 92.3,
        "messages": MessageAccount(**nothing),
        "connections": 1,
        "host_overruns": 0,
        "boots": (),
        "clock_outliers": 0,
        "clock_restarts": 0,
        "tasks": 9,
        "threads": 4,
        "file_descriptors": 23,
        "latency": {},
        "recording": status_samples.NOT_RECORDING,
    }
    return Health(**header(), **{**fields, **changes})


def decoded(traction_pascal: NDArray[np.float64], std_pascal: float = 100.0) -> Decoded:
    return Decoded(
        **header(),
        board_ticks=1,
        traction_pascal=traction_pascal.astype(np.float32),
        traction_std_pascal=np.full(traction_pascal.shape, std_pascal, np.float32),
        displacement_m=None,
        grid=Grid(origin_m=(-0.0062, -0.0062), pitch_m=4e-4),
    )


def patch(id: int, force_newton: tuple[float, float, float], **changes: Any) -> Patch:
    fields: dict[str, Any] = {
        "centroid_m": (0.0018, 0.0034),
        "centroid_std_m": (1e-5, 1e-5),
        "area_m2": 1.9e-5,
        "force_std_newton": (1e-3, 1e-3, 2e-3),
        "moment_newton_m": (0.0, 0.0, 0.0),
        "moment_std_newton_m": (0.0, 0.0, 0.0),
        "at_border": False,
        "radius_of_curvature_m": math.nan,
        "stick_ratio": math.nan,
        "slip_margin": math.nan,
        "slip_margin_std": math.nan,
        "friction_coefficient": math.nan,
        "friction_coefficient_std": math.nan,
        "slip_reason": "the contact slips too little to show in the signals",
    }
    return Patch(id=id, force_newton=force_newton, **{**fields, **changes})


def summary(
    *patches: Patch, border_contact: bool = False, status: str = "ok", reason: str = "", chi2: float = 1.02
) -> DecodedSummary:
    return DecodedSummary(
        **header(),
        board_ticks=1,
        decoder="open-plane+contact",
        chi2=chi2,
        border_contact=border_contact,
        status=status,
        reason=reason,
        patches=patches,
    )
