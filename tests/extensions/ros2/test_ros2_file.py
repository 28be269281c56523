"""MCAP for ROS 2, read by a program of others that knows nothing but what the file says of its messages."""

import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_bench import cloud_points, played, write
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from resonator_daemon.extensions.ros2.messages import make_typestore, ros_name


def written(case: str, path: Path) -> dict[str, list[Any]]:
    write("ros2", path, case)
    found: dict[str, list[Any]] = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, _, decoded in reader.iter_decoded_messages():
            found[channel.topic].append(decoded)
    return found


def points(cloud: Any) -> Any:
    assert (cloud.width * cloud.point_step, cloud.height, cloud.is_bigendian) == (cloud.row_step, 1, False)
    fields = [(field.name, field.datatype, field.offset) for field in cloud.fields]
    return cloud_points(bytes(cloud.data), fields, cloud.point_step)


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


@pytest.mark.parametrize("case", ["slide", "comb"])
def test_contacts_and_their_sum(case: str, tmp_path: Path) -> None:
    found, published = written(case, tmp_path / "ros.mcap"), played(case).messages("contacts")
    for one, wrench, message in zip(found["/left_index/contacts"], found["/left_index/wrench"], published, strict=True):
        assert stamp_ns(one) == stamp_ns(wrench) == message.t_ns
        assert one.header.frame_id == wrench.header.frame_id == "left_index"
        assert (one.status, one.reason_code) == (message.status, message.reason_code or "")
        assert [contact.id for contact in one.contacts] == [contact.id for contact in message.contacts]
        total = np.zeros((2, 3))
        for report, contact in zip(one.contacts, message.contacts, strict=True):
            np.testing.assert_array_equal(report.position_m, contact.position_m)
            for key in ("force_newton", "noise_newton", "systematic_newton"):
                np.testing.assert_array_equal(getattr(report, key), np.array(getattr(contact, key), float))
            assert (report.status, report.site) == (contact.status, contact.site)
            assert np.isnan(report.at_least_newton) == (contact.at_least_newton is None)
            assert np.isnan([*report.moment_newton_m, report.slip_margin]).all()
            normal_newton = np.array([0.0, 0.0, contact.force_newton[2]])
            total += normal_newton, np.cross([*contact.position_m, 0.0], normal_newton)
        np.testing.assert_allclose([xyz(wrench.wrench.force), xyz(wrench.wrench.torque)], total, atol=1e-12)
    events = [
        (one.event, one.contact.id, one.peak_newton, one.since.sec * 10**9 + one.since.nanosec, one.duration_s)
        for one in found["/left_index/contacts/event"]
    ]
    assert events == [
        (one.event, one.contact.id, one.contact.peak_newton, one.contact.since_t_ns, one.contact.duration_s)
        for one in played(case).messages("contacts/event")
    ]
    for cloud, message in zip(found["/left_index/forces/cloud"], played(case).messages("forces"), strict=True):
        np.testing.assert_array_equal(points(cloud)["force_newton"], [force.force_newton for force in message.sites])
    for one, message in zip(found["/left_index/forces"], played(case).messages("forces"), strict=True):
        assert (one.window_s, one.status, one.reason) == (message.window_s, message.status, message.reason or "")
        for report, force in zip(one.sites, message.sites, strict=True):
            assert (report.site, report.status) == (force.site, force.status)
            np.testing.assert_array_equal(
                [report.force_newton, report.noise_newton, report.systematic_newton],
                np.array([force.force_newton, force.noise_newton, force.systematic_newton], float),
            )


def test_a_skin_has_maps_and_vectors(tmp_path: Path) -> None:
    found = written("skin", tmp_path / "ros.mcap")
    for cloud, message in zip(found["/left_index/decoded/cloud"], played("skin").messages("decoded"), strict=True):
        np.testing.assert_array_equal(points(cloud)["traction_y_pascal"], message.traction_pascal[1].ravel())
        assert cloud.is_dense == bool(np.isfinite(message.traction_std_pascal).all())
    touched = 0
    for one, message in zip(found["/left_index/wrench"], played("skin").messages("contacts"), strict=True):
        total = sum((np.array([p.force_newton, p.moment_newton_m]) for p in message.contacts), np.zeros((2, 3)))
        np.testing.assert_allclose([xyz(one.wrench.force), xyz(one.wrench.torque)], total)
        touched += len(message.contacts)
    assert touched > 5
    contacts = [(m.t_ns, contact) for m in played("skin").messages("contacts") for contact in m.contacts]
    for one, (t_ns, contact) in zip(found["/left_index/contacts/wrench"], contacts, strict=True):
        arm = [*contact.position_m, 0.0]
        expected = np.array(contact.moment_newton_m) - np.cross(arm, contact.force_newton)
        assert (stamp_ns(one), one.header.frame_id) == (t_ns, "left_index_contact_0")
        np.testing.assert_allclose([xyz(one.wrench.force), xyz(one.wrench.torque)], [contact.force_newton, expected])
    for tree, (_, contact) in zip(found["/tf"], contacts, strict=True):
        (transform,) = tree.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("left_index", "left_index_contact_0")
        rotation = transform.transform.rotation
        assert xyz(transform.transform.translation) == [*contact.position_m, 0.0]
        assert [*xyz(rotation), rotation.w] == [0.0, 0.0, 0.0, 1.0]
    for one, message in zip(
        found["/left_index/decoded/summary"], played("skin").messages("decoded/summary"), strict=True
    ):
        assert (one.decoder, one.border_contact) == (message.decoder, message.border_contact)
        assert [patch.area_m2 for patch in one.patches] == [patch.area_m2 for patch in message.patches]
    assert len(found["/left_index/signals/cloud"]) == len(played("skin").messages("signals"))


def test_states_are_diagnostics(tmp_path: Path) -> None:
    found = written("refused", tmp_path / "ros.mcap")["/diagnostics"]
    states = [m for moment in played("refused").moments for t, m in moment.messages if t.path.startswith("state/")]
    levels = {"online": 0, "starting": 0, "refused": 2}
    for one, state in zip(found, states, strict=True):
        (status,) = one.status
        assert status.level == levels.get(state.state, 1)
        assert (stamp_ns(one), status.message) == (state.t_ns, f"{state.state}: {state.reason}")
        assert status.name in ("left_index: state/link", "left_index: state/sensor")


@pytest.mark.parametrize(
    ("name", "expected"), [("left-index", "left_index"), ("0042", "plate_0042"), ("_x", "plate__x"), ("a b", "a_b")]
)
def test_names_are_such_that_ros_takes_them(name: str, expected: str) -> None:
    assert ros_name(name) == expected


def test_the_package_of_ros_builds_the_types_of_the_product() -> None:
    package = Path("resonator_daemon/extensions/ros2/resonator_msgs")
    built = re.findall(r"msg/(\w+)\.msg\n", (package / "CMakeLists.txt").read_text())
    kinds = [kind for kind in make_typestore().fielddefs if kind.startswith("resonator_msgs/")]
    assert sorted(kinds) == sorted(f"resonator_msgs/msg/{name}" for name in built)
