"""Messages made from what is read and decoded under a skin, against hand-worked ones, in the words of the wire."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from report_makers import LOST, NAN, Messages, configured, gate_middle, literal

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces.readings import SkinReading
from resonator_daemon.estimate.surface.decoded import Decoded as DecodedFrame
from resonator_daemon.estimate.surface.fitting.fit_check import FitQuality
from resonator_daemon.estimate.surface.fitting.partial_slip import PartialSlip
from resonator_daemon.estimate.surface.patches import Patch as FoundPatch
from resonator_daemon.estimate.surface.skin_contacts import UNKNOWN_SYSTEMATIC, SkinContact, SkinEvent, Systematic
from resonator_daemon.estimate.surface.skin_decoder import SurfaceReading
from resonator_daemon.measure.sensors.surface_messages import SurfaceMessages
from resonator_daemon.measure.sensors.surface_requests import SurfaceFrame
from resonator_daemon.mqtt import payloads
from resonator_daemon.mqtt.codec import decode, encode
from resonator_daemon.mqtt.topics import DECODED, HeaderFields

LITTLE = Reason(ReasonCode.SLIPS_TOO_LITTLE, "hardly slips")
GATE_MIDDLE = gate_middle(10_000_000)


class SkinReporter:
    """The messages of a daemon and of its decoder, each under the header of its frame."""

    def __init__(self, config: Config) -> None:
        plate = config.plate
        self.messages = Messages(config)
        pitch_m = plate.grid.pitch_m if plate.grid else None
        self._surface = SurfaceMessages(plate.site_ids, plate.site_positions_m, pitch_m)

    def signals(self, reading: SkinReading, middle: Instant) -> payloads.Signals:
        self.messages.sensor.publish(reading, middle)
        return self.messages.published[-1][1]

    def decoded(self, reading: SkinReading, middle: Instant, frame: DecodedFrame) -> payloads.Decoded:
        return self._surface.decoded(self._header(reading, middle), frame)

    def summary(self, reading: SkinReading, middle: Instant, surface: SurfaceReading) -> payloads.DecodedSummary:
        return self._surface.summary(self._header(reading, middle), surface)

    def skin_contacts(self, reading: SkinReading, middle: Instant, surface: SurfaceReading) -> payloads.Contacts:
        return self._surface.contacts(self._header(reading, middle), surface)

    def skin_event(self, event: SkinEvent, reading: SkinReading, middle: Instant) -> payloads.ContactEvent:
        return self._surface.event(self._header(reading, middle), event)

    def _header(self, reading: SkinReading, middle: Instant) -> HeaderFields:
        return {"seq": self.messages.headers.next_seq(DECODED), **self.messages.output.window(reading, middle)}


@pytest.fixture
def skin_reporter(tmp_path: Path) -> SkinReporter:
    return SkinReporter(configured(tmp_path, "skin32"))


def channelised(signals: np.ndarray[Any, Any], window_s: float = 0.01) -> SkinReading:
    return SkinReading(7, 2**63 + 1, window_s, "ok", "", signals, np.ones_like(signals), 0.0)


def decoded(shape: tuple[int, ...], *, displacement: bool, **change: Any) -> DecodedFrame:
    values = np.arange(float(math.prod(shape))).reshape(shape)
    fields: dict[str, Any] = {
        "traction_pascal": values,
        "traction_std_pascal": values + 0.5,
        "displacement_m": -values if displacement else None,
        "border_contact": np.bool_(True),
        "log_evidence": -3.0,
        "chi2": 1.02,
        "status": "ok",
        "reason": "",
    }
    return DecodedFrame(**(fields | change))


@pytest.mark.parametrize("displacement", [True, False])
def test_decoded_keeps_each_array_in_its_place(skin_reporter: SkinReporter, displacement: bool) -> None:
    frame = decoded((3, 32, 32), displacement=displacement)
    measured = channelised(np.zeros((3, 1024)), window_s=0.004)
    message = decode(payloads.Decoded, encode(skin_reporter.decoded(measured, GATE_MIDDLE, frame)))
    values = np.arange(3 * 32 * 32, dtype=np.float32).reshape(3, 32, 32)
    np.testing.assert_array_equal(message.traction_pascal, values)
    np.testing.assert_array_equal(message.traction_std_pascal, values + 0.5)
    if displacement:
        np.testing.assert_array_equal(message.displacement_m, -values)
    else:
        assert message.displacement_m is None
    assert message.t_ns == 1_788_999_999_998_000_123
    assert message.grid is not None
    assert message.grid.origin_m == pytest.approx((-6.2e-3, -6.2e-3))  # 15.5 pitches from the middle
    assert message.grid.pitch_m == pytest.approx(4e-4)


def surface(frame: DecodedFrame, decoder: str = "open-plane+contact", **change: Any) -> SurfaceReading:
    return SurfaceReading(decoder, frame, **change)


def partial_slip(**change: Any) -> PartialSlip:
    fields: dict[str, Any] = {
        "centre_m": np.array([1.01e-3, -2.01e-3]), "centre_std_m": np.array([1e-6, 2e-6]), "radius_m": 2e-3,
        "radius_std_m": 1e-5, "force_newton": np.array([0.11, -0.21, 1.51]),
        "force_std_newton": np.array([1e-3, 2e-3, 3e-3]), "slip_margin": 0.125, "slip_margin_std": 0.01,
        "stick_ratio": 0.5, "stick_ratio_std": 0.02, "friction_coefficient": 0.6, "friction_coefficient_std": 0.03,
        "covariance": np.eye(7), "systematic": np.eye(7), "friction_coefficient_systematic": 0.02, "chi2": 1.0,
        "degrees_of_freedom": 3065, "status": "ok", "reason": None
    }  # fmt: skip
    return PartialSlip(**(fields | change))


def skin_contact(**change: Any) -> SkinContact:
    patch = FoundPatch(
        centroid_m=np.array([1e-3, -2.1e-3]),
        centroid_std_m=np.array([1e-5, 2e-5]),
        area_m2=1.9e-5,
        force_newton=np.array([0.1, -0.2, 1.5]),
        force_std_newton=np.array([3e-3, 4e-3, 5e-3]),
        moment_newton_m=np.array([1e-3, 2e-3, 3e-5]),
        moment_std_newton_m=np.array([1e-6, 2e-6, 3e-6]),
        at_border=True,
        places=np.arange(3),
    )
    fields: dict[str, Any] = {
        "id": 3, "patch": patch, "slip": partial_slip(), "fit": FitQuality(1.31, 3065, 1e-28),
        "systematic": Systematic(np.array([1e-3, 2e-3, 0.05]), np.array([1e-6, 2e-6]), 2e-5, 0.03, 0.02),
        "radius_of_curvature_m": 0.0056, "radius_of_curvature_std_m": 1e-4, "peak_newton": 1.75,
        "status": "contradicted", "reason": ReasonCode.FIT_CONTRADICTED
    }  # fmt: skip
    return SkinContact(**(fields | change))


PATCH_LITERAL = {
    "id": 3, "area_m2": pytest.approx(4e-6 * math.pi, rel=5e-3), "area_std_m2": 1.26e-7, "at_border": True,
    "radius_of_curvature_m": 0.0056, "radius_of_curvature_std_m": 1e-4, "stick_ratio": 0.5, "stick_ratio_std": 0.02
}  # fmt: skip
CONTACT_LITERAL = {
    "id": 3, "site": 339,  # row 10 at -2.2 mm, column 18 at 1.0 mm; ids begin at 1
    "position_m": [1e-3, -2.1e-3], "position_covariance_m2": [pytest.approx(1e-10), None, pytest.approx(4e-10)],
    "force_newton": [0.1, -0.2, 1.5], "noise_newton": [3e-3, 4e-3, 5e-3],
    "moment_newton_m": [1e-3, 2e-3, 3e-5], "moment_std_newton_m": [1e-6, 2e-6, 3e-6],
    "systematic_newton": [1e-3, 2e-3, 0.05], "position_systematic_m": [1e-6, 2e-6],
    "slip_margin": 0.125, "slip_margin_std": 0.01, "slip_margin_systematic": 0.03,
    "friction_coefficient": 0.6, "friction_coefficient_std": 0.03, "friction_coefficient_systematic": 0.02,
    "fit": {"chi2": 1.31, "degrees_of_freedom": 3065, "p": 1e-28},
    "status": "contradicted", "reason_code": "fit_contradicted",
}  # fmt: skip
HISTORY_LITERAL = {"peak_newton": 1.75, "since_t_ns": "1788999999995000123", "duration_s": 0.0}
MEASURED_OF_SKIN = channelised(np.zeros((3, 1024)))
OF_SLIP = (
    *("slip_margin", "slip_margin_std", "stick_ratio", "stick_ratio_std"),
    *("friction_coefficient", "friction_coefficient_std", "friction_coefficient_systematic"),
)
UNDECODED = {"border_contact": False}


def test_a_summary_is_the_contracts_literal(skin_reporter: SkinReporter) -> None:
    frame = decoded((3, 32, 32), displacement=False, reason="2 signals lost")
    said = literal(skin_reporter.summary(MEASURED_OF_SKIN, GATE_MIDDLE, surface(frame, contacts=(skin_contact(),))))
    assert said == {
        "name": "left-index", "seq": 0, "daemon_boot_id": "9f3c", "t_ns": "1788999999995000123",
        "t_uncertainty_ns": 42000, "lost": LOST, "board_ticks": str(2**63 + 1), "decoder": "open-plane+contact",
        "border_contact": True, "status": "ok", "reason": "2 signals lost",
        "patches": [PATCH_LITERAL]
    }  # fmt: skip


@pytest.mark.parametrize(
    ("slip", "why"),
    [
        (None, "not_fitted"),
        (partial_slip(**dict.fromkeys(OF_SLIP, NAN), status="unknown", reason=LITTLE), "slips_too_little"),
    ],
    ids=["no fit", "unknown"],
)
def test_what_is_not_known_of_a_patch_is_null(skin_reporter: SkinReporter, slip: PartialSlip | None, why: str) -> None:
    frame = decoded((3, 32, 32), displacement=False)
    unknown: dict[str, Any] = {"fit": None, "systematic": UNKNOWN_SYSTEMATIC, "status": "ok", "reason": None}
    contact = skin_contact(slip=slip, radius_of_curvature_m=NAN, radius_of_curvature_std_m=NAN, **unknown)
    said = literal(skin_reporter.summary(MEASURED_OF_SKIN, GATE_MIDDLE, surface(frame, contacts=(contact,))))
    of_fit = ("stick_ratio", "stick_ratio_std", "radius_of_curvature_m", "radius_of_curvature_std_m")
    area = {"area_m2": 1.9e-5, "area_std_m2": None} if slip is None else {}
    assert said["patches"] == [PATCH_LITERAL | dict.fromkeys(of_fit) | area]
    said = literal(skin_reporter.skin_contacts(MEASURED_OF_SKIN, GATE_MIDDLE, surface(frame, contacts=(contact,))))
    keys = ("slip_margin", "friction_coefficient")
    nothing = {f"{key}{kind}": None for key in keys for kind in ("", "_std", "_systematic")}
    nothing |= {"systematic_newton": [None] * 3, "position_systematic_m": [None] * 2, "status": "ok"}
    nothing |= {"slip_reason_code": why}
    (found,) = said["contacts"]
    assert found == {k: v for k, v in CONTACT_LITERAL.items() if k not in ("reason_code", "fit")} | nothing


@pytest.mark.parametrize("shape", ["punch", "ellipse"])
def test_a_named_shape_has_half_axes(skin_reporter: SkinReporter, shape: str) -> None:
    long = {"long_half_axis_m": np.array([2.5e-3, 1e-3]), "long_half_axis_std_m": np.array([1e-6, 2e-6])}
    short = {"short_half_axis_m": 1.6e-3, "short_half_axis_std_m": 3e-6}
    fit: Any = SimpleNamespace(shape=shape, **long, **short)
    frame = decoded((3, 32, 32), displacement=False)
    reading = surface(frame, contacts=(skin_contact(shape_fit=fit, status="ok", reason=None),))
    said = literal(skin_reporter.summary(MEASURED_OF_SKIN, GATE_MIDDLE, reading))
    of_ellipse = {"long_half_axis_m": [2.5e-3, 1e-3], "long_half_axis_std_m": [1e-6, 2e-6]}
    assert said["patches"] == [PATCH_LITERAL | short | (of_ellipse if shape == "ellipse" else {})]
    said = literal(skin_reporter.skin_contacts(MEASURED_OF_SKIN, GATE_MIDDLE, reading))
    assert [contact["shape"] for contact in said["contacts"]] == [shape]


@pytest.mark.parametrize("status", ["rejected", "no_signal"])
def test_a_frame_that_was_not_decoded_reports_it(skin_reporter: SkinReporter, status: str) -> None:
    frame = decoded((3, 32, 32), displacement=True, status=status, reason="why", **UNDECODED)
    said = literal(skin_reporter.summary(MEASURED_OF_SKIN, GATE_MIDDLE, surface(frame, "fourier")))
    expected = {"decoder": "fourier", "status": status, "reason": "why", "border_contact": False}
    assert said | expected == said
    assert said["patches"] == []
    contacts = literal(skin_reporter.skin_contacts(MEASURED_OF_SKIN, GATE_MIDDLE, surface(frame)))
    assert (contacts["status"], contacts["contacts"]) == (status, [])


@pytest.mark.parametrize("word", ["onset", "incipient_slip", "gross_slip", "release"])
def test_an_event_of_a_skin_reports_its_contact_with_its_peak(skin_reporter: SkinReporter, word: Any) -> None:
    said = literal(skin_reporter.skin_event(SkinEvent(word, skin_contact()), MEASURED_OF_SKIN, GATE_MIDDLE))
    assert said["event"] == word
    assert said["contact"] == CONTACT_LITERAL | HISTORY_LITERAL


def test_a_contact_of_a_skin_keeps_its_date_until_it_is_released(skin_reporter: SkinReporter) -> None:
    later = [gate_middle(10_000_000, later_ns=number * 10_000_000) for number in range(4)]
    onset = skin_reporter.skin_event(SkinEvent("onset", skin_contact()), MEASURED_OF_SKIN, later[0])
    release = skin_reporter.skin_event(SkinEvent("release", skin_contact()), MEASURED_OF_SKIN, later[2])
    assert onset.contact.since_t_ns == release.contact.since_t_ns
    again = skin_reporter.skin_event(SkinEvent("onset", skin_contact()), MEASURED_OF_SKIN, later[3])
    assert again.contact.since_t_ns == onset.contact.since_t_ns + 30_000_000


class Offers:
    """Decoding that keeps what it is offered."""

    def __init__(self) -> None:
        self.frames: list[SurfaceFrame] = []

    def offer(self, _origin: object, frame: SurfaceFrame) -> None:
        self.frames.append(frame)


def test_each_frame_that_is_offered_has_numbers_of_its_own(tmp_path: Path) -> None:
    offers = Offers()
    messages = Messages(configured(tmp_path, "skin32"), make_decoding=lambda *_: offers)
    measured = channelised(np.zeros((3, 1024)))
    for _ in range(2):
        messages.sensor.publish(measured, GATE_MIDDLE)
    assert messages.sensor.contacts_header((measured, GATE_MIDDLE))["seq"] == 2
    messages.sensor.publish(measured, GATE_MIDDLE)
    assert [message.seq for _, message in messages.published] == [0, 1, 2]
    assert [(frame.header["seq"], frame.contacts_seq) for frame in offers.frames] == [(0, 0), (1, 1), (2, 3)]
