"""What a decoder reads of a plate: what cannot be used is counted, and nothing raises."""

import json
import random
from collections.abc import Iterator
from typing import Any

import cbor2
import numpy as np
import pytest
from decoder_bench import incoming, info, signals

from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.extensions.remote_decoding import info as info_module
from resonator_daemon.extensions.remote_decoding.plate import RemotePlate
from resonator_daemon.measure.sensors.output import LatencyHistogram
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import SiteInfo

SKIN = info().skin
assert SKIN is not None


class Plate(RemotePlate):
    """A plate that nothing decodes."""

    def __init__(self) -> None:
        super().__init__(
            DecoderConfig(name="hand"), "hand", "host-1", lambda _topic, _message: None, LatencyHistogram()
        )
        self._info, self._signals = self.subscriptions

    def read_info(self, payload: bytes) -> bool:
        """Return whether the skin is another one now."""
        before = self.settings
        self._info.handle(incoming(self._info.topic_filter, payload))
        return self.settings is not before

    @property
    def problem(self) -> str | None:
        """Why there are no settings; None if there are."""
        return self.condition()[1].text if self.settings is None else None

    def take(self, payload: bytes) -> bool:
        """Return whether signals can be decoded."""
        unusable = self.health().unusable
        self._signals.handle(incoming(self._signals.topic_filter, payload))
        return self.health().unusable == unusable


@pytest.fixture
def plate() -> Plate:
    known = Plate()
    assert known.read_info(encode(info()))
    return known


@pytest.mark.parametrize(
    "change",
    [
        {"sites": info().sites[:-1], "grid": None},
        {"sites": (SiteInfo(site=1, position_m=(0.5, 0.5)), *info().sites[1:]), "grid": None},
        {"sites": (SiteInfo(site=1, position_m=info().sites[0].position_m), *info().sites[1:])},
        {"skin": SKIN.model_copy(update={"depth_m": 1.1e-3})},
        {"skin": SKIN.model_copy(update={"gain_std": 0.01})},
        {"skin": SKIN.model_copy(update={"youngs_modulus_pascal": 3e5})},
    ],
)
def test_another_skin_is_noticed_and_the_same_one_is_not(plate: Plate, change: dict[str, Any]) -> None:
    assert not plate.read_info(encode(info(daemon_version="0.2.0")))
    assert plate.read_info(encode(info(**change)))
    assert not plate.read_info(encode(info(**change)))


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        (b"", "no info yet"),
        (b"\xff\xfe", "info cannot be read"),
        (encode(info(skin=None)), "has no skin"),
        (encode(info(schema_version="1.0")), "schema version '1.0', this decoder reads 2"),
        (encode(info(skin=SKIN.model_copy(update={"depth_m": 0.0}))), "depth"),
        (encode(info(sites=())), "no sites"),
        (encode(info(sites=(SiteInfo(site=2**63, position_m=(0.0, 0.0)),))), "2^63 - 1"),
        (encode(info(frame_rate_hz=0.0)), "frame_rate_hz is 0.0"),
        (encode(info(rates_hz={"signals": 100.0, "decoded": 100.0, "decoded/5hz": 5.0})), "external = true"),
        (encode(info(frame_rate_hz=5e-324)), "frame_rate_hz is 5e-324"),
    ],
)
def test_an_info_that_is_no_use_says_why(plate: Plate, payload: bytes, problem: str) -> None:
    assert plate.read_info(payload)
    assert plate.settings is None
    assert problem in str(plate.problem)
    assert not plate.take(encode(signals(0)))
    assert (plate.health().received, plate.health().unusable) == (1, 1)
    assert plate.read_info(encode(info()))
    assert plate.take(encode(signals(1)))


TOO_LONG = [
    (encode(info(sites=info().sites * 70)), "10080 entries in 'sites', a decoder takes 10000 sites at most"),
    (encode(info(outline_m=((0.0, 0.0),) * 10_001)), "10001 entries in 'outline_m'"),
    (encode(info(units={f"_{number}": "m" for number in range(10_001)})), "10001 entries in 'units'"),
    (encode(info()).ljust(2_000_001), "info has 2000001 bytes, a decoder reads 2000000 at most"),
]


@pytest.mark.parametrize(("payload", "problem"), TOO_LONG, ids=range(len(TOO_LONG)))
def test_an_info_that_is_too_long_is_refused_before_it_is_checked_entry_by_entry(
    plate: Plate, payload: bytes, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(info_module, "decode", pytest.fail)
    assert plate.read_info(payload)
    assert problem in str(plate.problem)
    assert plate.settings is None


def test_an_info_of_10_000_sites_and_one_of_2_mb_are_read(plate: Plate) -> None:
    sites = tuple(SiteInfo(site=number, position_m=(1e-3 * number / 3, 2e-3 / 7)) for number in range(10_000))
    assert plate.read_info(encode(info(sites=sites, grid=None)))
    assert plate.problem is None
    assert plate.read_info(encode(info()).ljust(2_000_000))
    assert plate.problem is None


ABSURD = [2**63, 2**70, -1, -(2**63) - 1, 1e308, -1e308, 5e-324, 0, "x" * 1000, None, [], {}, True]
ABSURD_JSON = [*(json.dumps(value) for value in ABSURD), "1" + "0" * 5000, "1e999", "NaN"]


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Return each container in a message with the keys that it has; of a list the first two."""
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value[:2])):
            yield value, key
            yield from places(value[key])


def test_no_absurdity_anywhere_in_info_raises(plate: Plate) -> None:
    whole, tried = json.loads(encode(info(sites=info().sites[:9], grid=None))), 0
    for container, key in list(places(whole)):
        kept, container[key] = container[key], "absurd"
        for text in ABSURD_JSON:
            plate.read_info(json.dumps(whole).replace('"absurd"', text).encode())
            assert (plate.settings is None) == (plate.problem is not None)
            tried += 1
        container[key] = kept
    assert tried > 600


HOSTILE = [
    b"",
    b"\xa0",
    b"\x9f" * 100_000,  # arrays in arrays
    encode(signals(0))[:-1],
    encode(signals(0)) + b"\x00",
    encode(signals(0, np.zeros((3, 4)), noise_std=np.ones((3, 4), np.float32))),
    encode(signals(0, np.zeros((3, 12, 12)), noise_std=np.ones((3, 12, 12), np.float32))),
    encode(signals(0, status="settling")),
    encode(signals(0).model_copy(update={"seq": 2**63})),
    encode(signals(0, t_uncertainty_ns=2**63)),
    encode(signals(0, lost={"link_gap": 2**70})),
    cbor2.dumps(cbor2.CBORTag(40, [[2**40, 2**40], cbor2.CBORTag(85, b"")])),
    cbor2.dumps(cbor2.CBORTag(2, b"\xff" * 10_000)),
]


@pytest.mark.parametrize("payload", HOSTILE, ids=range(len(HOSTILE)))
def test_what_is_no_frame_of_this_skin_is_counted(plate: Plate, payload: bytes) -> None:
    assert not plate.take(payload)
    assert (plate.health().received, plate.health().unusable) == (1, 1)
    assert plate.take(encode(signals(0)))
    assert plate.health().missed == 0


def test_mutated_frames_never_raise(plate: Plate) -> None:
    whole, rng, used = encode(signals(3)), random.Random(7), 0
    for _ in range(3000):
        payload = bytearray(whole)
        for _ in range(rng.randrange(1, 8)):
            payload[rng.randrange(200 if rng.random() < 0.7 else len(whole))] = rng.randrange(256)
        used += plate.take(bytes(payload[: rng.randrange(len(whole))] if rng.random() < 0.2 else payload))
    assert plate.health().received == 3000 == used + plate.health().unusable
    assert 0 < used < 3000


def test_gaps_of_one_daemon_are_missed_frames(plate: Plate) -> None:
    for seq in (5, 6, 9, 9, 8, 10):  # 7 and 8 missing; 8 comes late, 9 twice
        plate.take(encode(signals(seq)))
    assert plate.health().missed == 2
    plate.take(encode(signals(0, boot="another")))
    plate.take(encode(signals(2, boot="another")))
    assert plate.health().missed == 3
