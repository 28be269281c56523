"""What counts as a difference between a message and the one that was expected."""

from typing import Any

import pytest

from resonator_daemon.replay.checking import ABSENT, Difference, Scales, payload_differences

EXPECTED = {"a": 1, "b": "one", "f": [0.0, 2.0], "g": [{"x": 1e-9}, {"x": 4e-9}], "n": None, "t": True}


def differences(got: dict[str, Any], topic: str = "forces") -> list[Difference]:
    scales = Scales()
    scales.add(topic, EXPECTED)
    return list(payload_differences(topic, EXPECTED, got, scales))


@pytest.mark.parametrize("change", [{}, {"f": [1.9e-6, 2.0 - 1.9e-6]}, {"g": [{"x": 1e-9 + 3.9e-15}, {"x": 4e-9}]}])
def test_what_other_processors_round_is_none(change: dict[str, Any]) -> None:
    assert differences(EXPECTED | change) == []


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"a": 2}, Difference("a", 1, 2)),
        ({"a": 1.0}, Difference("a", 1, 1.0)),
        ({"n": 0.0}, Difference("n", None, 0.0)),
        ({"f": [2.1e-6, 2.0]}, Difference("f[0]", 0.0, 2.1e-6)),
        ({"f": [0.0, 2.0, 3.0]}, Difference("f[]", "2 elements", "3 elements")),
        ({"g": [{"x": 1e-9 + 4.1e-15}, {"x": 4e-9}]}, Difference("g[0].x", 1e-9, 1e-9 + 4.1e-15)),
        ({"g": [{}, {"x": 4e-9}]}, Difference("g[0].x", 1e-9, ABSENT)),
        ({"more": 1}, Difference("more", ABSENT, 1)),
    ],
)
def test_what_is_one(change: dict[str, Any], found: Difference) -> None:
    assert differences(EXPECTED | change) == [found]


def test_the_largest_value_of_a_field_sets_its_scale_in_whatever_order_they_come() -> None:
    for values in ([0.0, 2.0], [2.0, 0.0], [-2.0, 1.0, 0.5]):
        scales = Scales()
        scales.add("forces", {"f": values})
        assert scales.tolerance("forces.f[]") == pytest.approx(2e-6)


def test_another_version_says_the_same() -> None:
    scales = Scales()
    old, new = {"plate": "p", "daemon_version": "0.8"}, {"plate": "p", "daemon_version": "0.9"}
    assert list(payload_differences("info", old | {"commands": []}, new | {"commands": ["ping"]}, scales)) == []
    assert list(payload_differences("forces", old, new, scales)) == [Difference("daemon_version", "0.8", "0.9")]
