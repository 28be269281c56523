"""The score of the demo on hand-made truth and messages, by the definitions of the `demo --json` contract."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from resonator_daemon.demo.score import Accuracy, PlateScore
from resonator_daemon.demo.truth import TruthTable
from resonator_daemon.publishing.payloads import (
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    EventContact,
    Forces,
    Grid,
    Health,
    Lost,
    Patch,
    SiteForce,
)

T0_NS = 1_789_000_000_000_000_000
MS = 1_000_000
FRAME_NS = MS
TICKS = 1000  # in a gate
HEADER: dict[str, Any] = {
    "seq": 0,
    "daemon_boot_id": "9f3c",
    "board_boot_id": "51aa",
    "t_ns": T0_NS,
    "t_unc_ns": 0,
    "lost": Lost(),
}
FAR_NS = T0_NS + 10**12


def frame_end_ns(number: int) -> int:
    return T0_NS + number * FRAME_NS


def touch(
    f_z: float,
    *,
    id: int = 1,
    site: int | None = 7,
    shear: tuple[float, float] = (0.0, 0.0),
    position_m: tuple[float, float] = (0.0, 0.0),
) -> dict[str, Any]:
    return {"id": id, "site": site, "position_m": position_m, "force_newton": [*shear, f_z], "radius_m": None}


SITES_M = np.array([[0.0, 0.0], [1.5e-3, 0.0], [0.0, -2.0e-3], [4e-3, 4e-3]])


class Run:
    """A plate's truth file and score."""

    def __init__(self, path: Path, window_frames: int) -> None:
        self._path = path
        self._truth = TruthTable(path)
        self.score = PlateScore(self._truth, window_frames, SITES_M)
        self.frames = 0

    def truth(self, *contacts: dict[str, Any]) -> int:
        """Write the truth of the next frame; return the frame's number."""
        self.write(self.line(self.frames, *contacts))
        self.frames += 1
        return self.frames - 1

    @staticmethod
    def line(number: int, *contacts: dict[str, Any]) -> str:
        line = {
            "sequence": number,
            "board_ticks": TICKS * (number + 1),
            "t_ns": str(frame_end_ns(number)),
            "contacts": list(contacts),
            "plate_kelvin": 298.4,
        }
        return json.dumps(line) + "\n"

    def write(self, text: str) -> None:
        with self._path.open("a") as file:
            file.write(text)

    def ramp(self, *f_z: float, **touched: Any) -> None:
        for newton in f_z:
            self.truth(touch(newton, **touched))

    def health(self, frames: int, **lost: int) -> None:
        counted: dict[str, Any] = {"frames": frames, "lost": Lost(**lost)}  # of the rest nothing is looked at
        self.score.take(Health.model_construct(**counted), FAR_NS)

    def onset(self, arrived_ns: int, site: int = 7, event: Any = "onset") -> None:
        contact = EventContact(
            id=1,
            site=site,
            position_m=(0.0, 0.0),
            position_std_m=(0.0, 0.0),
            force_newton=0.02,
            noise_newton=0.0,
            systematic_newton=0.0,
            since_t_ns=T0_NS,
            status="ok",
            peak_newton=0.02,
        )
        self.score.take(ContactEvent(**HEADER, board_ticks=1, event=event, contact=contact), arrived_ns)

    def forces(self, number: int, *sites: tuple[int, float], arrived_ns: int = FAR_NS) -> None:
        """Take the message of the window whose last gate was frame `number`."""
        forces = tuple(
            SiteForce(site=site, force_newton=newton, noise_newton=0.0, systematic_newton=0.0, status="ok")
            for site, newton in sites
        )
        message = Forces(**HEADER, board_ticks=TICKS * (number + 1), window_s=0.01, status="ok", sites=forces)
        self.score.take(message, arrived_ns)

    def decoded(
        self, number: int, traction_pascal: NDArray[np.float64], *, grid: bool = True, arrived_ns: int = FAR_NS
    ) -> None:
        message = Decoded(
            **HEADER,
            board_ticks=TICKS * (number + 1),
            traction_pascal=traction_pascal,
            traction_std_pascal=np.zeros_like(traction_pascal),
            displacement_m=None,
            grid=Grid(origin_m=(0.0, 0.0), pitch_m=PITCH_M) if grid else None,
        )
        self.score.take(message, arrived_ns)

    def patches(self, number: int, *patches: tuple[tuple[float, float], float]) -> None:
        """Take the summary of frame `number`: centroids and normal forces."""
        told = tuple(
            Patch.model_construct(id=id, centroid_m=centroid_m, force_newton=(0.3, 0.0, newton))
            for id, (centroid_m, newton) in enumerate(patches, 1)
        )
        message = DecodedSummary(
            **HEADER,
            board_ticks=TICKS * (number + 1),
            decoder="open-plane+contact",
            chi2=1.0,
            border_contact=False,
            status="ok",
            reason="",
            patches=told,
        )
        self.score.take(message, FAR_NS)

    def result(self, until_ns: int = FAR_NS) -> Accuracy:
        self.score.join()
        return self.score.accuracy(until_ns)

    def found(self, until_ns: int = FAR_NS) -> tuple[int, int, int]:
        """Touches, those found, those at the right site."""
        result = self.result(until_ns)
        return result.touches, result.found, result.sites_right

    def close(self) -> None:
        self._truth.close()


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Windows of two frames."""
    run = Run(tmp_path / "truth.jsonl", window_frames=2)
    yield run
    run.close()


# Latency: from the end of the last gate in the window, by the emulator's clock, to the subscriber.


def test_latency_counts_from_the_end_of_the_last_gate(run: Run) -> None:
    for _ in range(6):
        run.truth()
    run.forces(3, arrived_ns=frame_end_ns(3) + 2_100_000)
    run.forces(5, arrived_ns=frame_end_ns(5) + 7_900_000)
    run.decoded(4, np.zeros((3, 2, 2)), arrived_ns=frame_end_ns(4) + 4_250_000)
    assert run.result().latency_ms == pytest.approx([2.1, 7.9, 4.25])


def test_a_message_waits_for_its_truth_and_counts_once(run: Run) -> None:
    run.forces(1, (7, 1.003), arrived_ns=frame_end_ns(1) + 3 * MS)
    run.score.join()  # no truth file yet
    run.truth(touch(1.0))
    whole = run.line(1, touch(1.0))
    run.write(whole[:-20])
    run.score.join()  # a line that is not whole yet
    assert run.score.latency_ms == []
    run.write(whole[-20:])
    for _ in range(3):
        run.score.join()
    assert run.score.latency_ms == pytest.approx([3.0])
    assert run.result().force_error_newton_rms == pytest.approx(0.003)


def test_nothing_measured_is_no_score(run: Run) -> None:
    run.truth()
    assert run.result() == Accuracy()


# A contact is found when its onset arrives within 50 ms of the moment when the true force crosses 20 mN.


@pytest.mark.parametrize(
    ("after_ns", "found"),
    [(0, 1), (12 * MS, 1), (50 * MS, 1), (50 * MS + 1, 0), (-50 * MS, 1), (-50 * MS - 1, 0), (-(10**9), 0)],
)
def test_an_onset_within_50_ms_of_the_crossing_finds_a_touch(run: Run, after_ns: int, found: int) -> None:
    run.ramp(0.005, 0.012, 0.0199, 0.0201, 0.5, 1.0)
    run.onset(frame_end_ns(3) + after_ns)
    assert run.found() == (1, found, found)


def test_the_crossing_is_the_first_one(run: Run) -> None:
    run.ramp(*([0.019] + [1.0, 0.01] * 100))
    run.onset(frame_end_ns(1) + 51 * MS)  # 1 ms after a later crossing of the same touch
    assert run.found() == (1, 0, 0)


def test_a_touch_of_20_mn_counts_and_less_does_not(run: Run) -> None:
    run.ramp(0.005, 0.019999, 0.005, id=1)
    run.ramp(0.005, 0.020, 0.005, id=2)
    assert run.found() == (1, 0, 0)


def test_shear_does_not_make_a_touch(run: Run) -> None:
    run.truth(touch(0.019, shear=(0.03, 0.03)))
    assert run.found() == (0, 0, 0)


def test_an_onset_at_another_site_finds_the_touch_but_not_its_site(run: Run) -> None:
    run.ramp(0.0, 1.0)
    run.onset(frame_end_ns(1) + 10 * MS, site=8)
    assert run.found() == (1, 1, 0)


def test_only_an_onset_finds(run: Run) -> None:
    run.ramp(0.0, 1.0)
    run.onset(frame_end_ns(1) + 10 * MS, event="release")
    run.score.take(Contacts(**HEADER, board_ticks=1, status="ok", contacts=()), frame_end_ns(1))
    assert run.found() == (1, 0, 0)


def test_each_touch_needs_an_onset_of_its_own_time(run: Run) -> None:
    for number in range(3):
        run.ramp(0.0, 1.0, id=number + 1, site=number + 5)
        for _ in range(198):
            run.truth()
    run.onset(frame_end_ns(1) + 10 * MS, site=5)
    run.onset(frame_end_ns(401) + 60 * MS, site=7)  # the third, too late
    assert run.found() == (3, 1, 1)


def test_two_touches_at_once_are_two(run: Run) -> None:
    run.truth()
    run.truth(touch(1.0, id=1, site=5), touch(0.5, id=2, site=6))
    run.onset(frame_end_ns(1) + 10 * MS, site=6)
    run.onset(frame_end_ns(1) + 12 * MS, site=5)
    assert run.found() == (2, 2, 2)


@pytest.mark.parametrize(("until_after_ns", "counts"), [(50 * MS, 1), (50 * MS - 1, 0), (0, 0), (-1, 0)])
def test_a_touch_that_had_no_time_to_be_found_does_not_count(run: Run, until_after_ns: int, counts: int) -> None:
    run.ramp(0.0, 1.0)
    run.onset(frame_end_ns(1) + 10 * MS)
    assert run.found(frame_end_ns(1) + until_after_ns) == (counts, counts, counts)


# Force error: against the truth averaged over the same window, contacts above 5 % of their peak.


def test_force_errors_are_pooled_over_windows_against_their_mean_truth(run: Run) -> None:
    run.ramp(1.0, 2.0, 2.0, 3.0)  # means of the windows of two: 1.5, 2.0, 2.5
    run.forces(1, (7, 1.503))
    run.forces(2, (7, 1.996))
    run.forces(3, (7, 2.512))
    assert run.result().force_error_newton_rms == pytest.approx(math.sqrt((9 + 16 + 144) / 3) * 1e-3)


def test_a_touch_that_lasts_part_of_a_window_counts_by_its_mean(run: Run) -> None:
    run.truth()
    run.truth(touch(0.4))
    run.forces(1, (7, 0.21))
    assert run.result().force_error_newton_rms == pytest.approx(0.010)


def test_only_forces_above_5_percent_of_their_own_touchs_peak_count(run: Run) -> None:
    run.ramp(0.09, 0.09, 2.0, 2.0, id=1)  # the peak comes after the weak window
    run.ramp(0.03, 0.03, id=2, site=8)  # a weak touch is measured by its own peak
    run.forces(1, (7, 0.5))  # 0.09 is 4.5 % of the peak: an error of 0.41 that does not count
    run.forces(3, (7, 2.003))
    run.forces(5, (8, 0.034))
    assert run.result().force_error_newton_rms == pytest.approx(math.sqrt((9 + 16) / 2) * 1e-3)


@pytest.mark.parametrize(("newton", "counts"), [(0.0499, False), (0.0501, True)])
def test_the_share_that_counts_is_5_percent(run: Run, newton: float, counts: bool) -> None:
    run.ramp(newton, newton, 1.0)
    run.forces(1, (7, newton + 0.01))
    assert run.result().force_error_newton_rms == (pytest.approx(0.01) if counts else None)


def test_touches_at_once_are_compared_site_by_site(run: Run) -> None:
    for _ in range(2):
        run.truth(touch(1.0, id=1, site=5), touch(2.0, id=2, site=6))
    run.forces(1, (6, 2.004), (5, 1.003))
    assert run.result().force_error_newton_rms == pytest.approx(math.sqrt((9 + 16) / 2) * 1e-3)


def test_a_force_that_is_not_known_is_no_error(run: Run) -> None:
    run.ramp(1.0, 1.0, 1.0, 1.0)
    run.forces(1, (7, math.nan))
    run.forces(2)
    assert run.result().force_error_newton_rms is None
    run.forces(3, (7, 1.003))
    assert run.result().force_error_newton_rms == pytest.approx(0.003)


def test_a_force_where_nothing_touches_is_not_pooled(run: Run) -> None:
    run.ramp(1.0, 1.0)
    run.forces(1, (7, 1.003), (8, 0.5))
    assert run.result().force_error_newton_rms == pytest.approx(0.003)


# Traction error: sqrt(sum err^2 / sum truth^2) pooled over frames whose net force exceeds 5 % of the peak.

SHAPE = NY, NX = 16, 20
PITCH_M = 4e-4


def hertz(newton: float, x_m: float = 0.0, y_m: float = 0.0) -> NDArray[np.float64]:
    """Tractions (3, ny, nx) of a press without shear, radius 2.5 mm at 1 N, averaged by 24 x 24 points in a pixel."""
    a = 2.5e-3 * newton ** (1 / 3)
    x = ((np.arange(NX * 24) + 0.5) / 24 - NX / 2) * PITCH_M - x_m
    y = ((np.arange(NY * 24) + 0.5) / 24 - NY / 2) * PITCH_M - y_m
    pressure = 3 * newton / (2 * math.pi * a**2) * np.sqrt(np.maximum(1 - (x**2 + y[:, None] ** 2) / a**2, 0.0))
    return np.array([np.zeros(SHAPE), np.zeros(SHAPE), pressure.reshape(NY, 24, NX, 24).mean(axis=(1, 3))])


def skin_touch(f_z: float, **touched: Any) -> dict[str, Any]:
    return touch(f_z, site=None, **touched)


def test_nothing_decoded_of_a_touch_is_an_error_of_one(run: Run) -> None:
    for newton in (0.5, 1.0):
        run.decoded(run.truth(skin_touch(newton)), np.zeros((3, *SHAPE)))
    assert run.result().traction_error == pytest.approx(1.0)


def test_a_true_map_has_no_error_and_a_shifted_one_has(run: Run) -> None:
    run.decoded(run.truth(skin_touch(1.0, position_m=(1e-3, -6e-4))), hertz(1.0, 1e-3, -6e-4))
    assert run.result().traction_error == pytest.approx(0.0, abs=2e-3)
    run.decoded(run.truth(skin_touch(1.0, position_m=(1e-3, -6e-4))), hertz(1.0, -6e-4, 1e-3))
    assert (run.result().traction_error or 0.0) > 0.3


def test_tractions_are_pooled_over_frames_before_the_ratio(run: Run) -> None:
    errors = np.zeros((2, 3, *SHAPE))
    errors[0, 0, 3, 5], errors[0, 2, 8, 8] = 30e3, -40e3
    errors[1, 1] = 2e3
    for newton, error in zip((0.4, 1.0), errors, strict=True):
        run.decoded(run.truth(skin_touch(newton)), hertz(newton) + error)
    squares = 30e3**2 + 40e3**2 + NY * NX * 2e3**2
    truth = np.sum(hertz(0.4) ** 2) + np.sum(hertz(1.0) ** 2)
    assert run.result().traction_error == pytest.approx(math.sqrt(squares / truth), rel=5e-3)


def test_weak_frames_and_untouched_ones_do_not_count(run: Run) -> None:
    wild = np.full((3, *SHAPE), 1e5)
    run.decoded(run.truth(), wild)
    run.decoded(run.truth(skin_touch(0.049)), wild)
    run.decoded(run.truth(skin_touch(1.0)), np.zeros((3, *SHAPE)))
    assert run.result().traction_error == pytest.approx(1.0)
    # Of 0.045 N and 0.0225 N of shear, the net force is 0.0503 N.
    run.decoded(run.truth(skin_touch(0.045, shear=(0.0135, -0.018))), wild)
    assert (run.result().traction_error or 0.0) > 3.0


def test_the_net_force_is_that_of_all_contacts(run: Run) -> None:
    wild = np.full((3, *SHAPE), 1e5)
    run.decoded(run.truth(skin_touch(1.0)), np.zeros((3, *SHAPE)))
    pair = (skin_touch(0.03, id=2, position_m=(-2e-3, 0.0)), skin_touch(0.03, id=3, position_m=(2e-3, 0.0)))
    run.decoded(run.truth(*pair), wild)
    assert (run.result().traction_error or 0.0) > 3.0


def test_each_decoded_frame_is_compared_with_its_own_gate(run: Run) -> None:
    run.truth(skin_touch(0.3))
    middle = run.truth(skin_touch(1.0))
    run.truth(skin_touch(0.3))
    run.decoded(middle, hertz(1.0))
    assert run.result().traction_error == pytest.approx(0.0, abs=2e-3)


def test_a_map_that_is_not_known_is_no_error_but_was_received(run: Run) -> None:
    run.decoded(run.truth(skin_touch(1.0)), np.full((3, *SHAPE), math.nan))
    assert run.result().traction_error is None
    run.decoded(run.truth(skin_touch(1.0)), np.full((3, 4), math.nan), grid=False)
    run.decoded(run.truth(skin_touch(1.0)), np.zeros((3, *SHAPE)))
    assert run.result().traction_error == pytest.approx(1.0)
    assert run.score.decoded_frames == 3


def test_an_untouched_run_has_no_traction_error(run: Run) -> None:
    run.decoded(run.truth(), np.full((3, *SHAPE), 1e5))
    assert run.result().traction_error is None


def test_a_map_of_scattered_sites_is_compared_point_by_point(run: Run) -> None:
    number = run.truth(skin_touch(1.0, shear=(0.2, 0.0)))
    a, p_0 = 2.5e-3, 1.5 / (math.pi * 2.5e-3**2)
    c = a * (1 - 0.2 / 0.5) ** (1 / 3)
    r = np.linalg.norm(SITES_M, axis=1)
    pressure, stuck = (np.sqrt(np.maximum(1 - (r / radius) ** 2, 0.0)) for radius in (a, c))
    true = p_0 * np.array([0.5 * (pressure - stuck * c / a), np.zeros(4), pressure])  # Cattaneo and Mindlin
    assert true[2].tolist() == pytest.approx([p_0, 0.8 * p_0, 0.6 * p_0, 0.0])
    run.decoded(number, true, grid=False)
    assert run.result().traction_error == pytest.approx(0.0, abs=1e-6)
    run.decoded(number, true + np.array([[0.0], [3e3], [0.0]]), grid=False)
    assert run.result().traction_error == pytest.approx(math.sqrt(4 * 3e3**2 / (2 * np.sum(true**2))), rel=1e-5)


# Contacts of a skin: normal force and centroid of the patch nearest to each true contact, above 5 % of its peak.


def test_patches_are_compared_with_the_contacts_they_are_nearest_to(run: Run) -> None:
    run.truth(skin_touch(1.0, id=1, position_m=(-2e-3, 0.0)), skin_touch(0.5, id=2, position_m=(3e-3, 1e-3)))
    run.patches(0, ((3e-3, 1.03e-3), 0.52), ((-2.04e-3, 0.0), 0.97))
    result = run.result()
    assert result.force_error_newton_rms == pytest.approx(math.sqrt((0.02**2 + 0.03**2) / 2))
    assert result.position_error_m_rms == pytest.approx(math.sqrt((0.03**2 + 0.04**2) / 2) * 1e-3)
    assert result.latency_ms == []  # of a skin it is that of `decoded`


def test_weak_contacts_and_frames_without_patches_are_no_error_of_the_patches(run: Run) -> None:
    run.ramp(0.049, 1.0, 1.0)
    run.patches(0, ((9e-3, 0.0), 0.5))
    run.patches(1)
    assert run.result().position_error_m_rms is None
    run.patches(2, ((1e-4, 0.0), 1.0))
    assert run.result().position_error_m_rms == pytest.approx(1e-4)
    run.score.begin(0)
    assert run.result().position_error_m_rms is None


# What came before `begin` belongs to the set-up.


def test_errors_and_latency_count_from_the_beginning(run: Run) -> None:
    run.ramp(1.0, 1.0, 1.0, 1.0)
    run.forces(1, (7, 1.5), arrived_ns=frame_end_ns(1) + 90 * MS)
    run.decoded(1, np.zeros((3, 2, 2)), arrived_ns=frame_end_ns(1) + 90 * MS)
    run.score.begin(frame_end_ns(2))
    assert run.result(frame_end_ns(3)) == Accuracy()
    run.forces(3, (7, 1.003), arrived_ns=frame_end_ns(3) + 3 * MS)
    result = run.result()
    assert result.latency_ms == pytest.approx([3.0])
    assert result.force_error_newton_rms == pytest.approx(0.003)
    assert (run.score.decoded_frames, result.traction_error) == (0, None)


@pytest.mark.parametrize(("begin_after_ns", "counts"), [(-1, 1), (0, 1), (1, 0)])
def test_a_touch_before_the_beginning_does_not_count(run: Run, begin_after_ns: int, counts: int) -> None:
    run.ramp(0.0, 1.0, 1.0)
    run.score.begin(frame_end_ns(1) + begin_after_ns)
    run.onset(frame_end_ns(1) + 10 * MS)
    assert run.found() == (counts, counts, counts)


def test_a_force_is_weighed_by_the_peak_of_its_whole_touch(run: Run) -> None:
    run.ramp(2.0, 0.09, 0.09)
    run.score.begin(frame_end_ns(0) + 1)
    run.forces(2, (7, 0.5))
    assert run.result().force_error_newton_rms is None


def test_losses_are_those_since_the_beginning(run: Run) -> None:
    run.health(100, damaged=3, publish_dropped=2)
    run.score.begin(T0_NS)
    assert set(run.score.lost.values()) == {0}
    run.health(200, damaged=3, publish_dropped=7, link_gap=1)
    assert run.score.lost == {
        "link_gap": 1,
        "damaged": 0,
        "board_overflow": 0,
        "host_overrun": 0,
        "publish_dropped": 5,
    }


def test_frames_are_those_since_the_last_before_the_beginning(run: Run) -> None:
    assert run.score.frames == 0
    run.ramp(*[0.0] * 12)
    run.forces(4)
    run.score.begin(frame_end_ns(5))  # five frames, 0 to 4, are past
    run.health(7)
    run.health(12)
    assert run.score.frames == 7
