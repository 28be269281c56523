"""What a decoder reads of a plate: what cannot be used is counted, and nothing raises."""

import random
from typing import Any

import cbor2
import numpy as np
import pytest
from decoder_bench import SITES, SITES_M, info, signals

from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import SiteInfo
from resonator_daemon.remote_decoding.plate import RemotePlate, header_of

SKIN = info().skin
assert SKIN is not None


@pytest.fixture
def plate() -> RemotePlate:
    known = RemotePlate("hand")
    assert known.take_info(encode(info()))
    return known


def take(plate: RemotePlate, payload: bytes) -> bool:
    return plate.take_signals(payload, 1.0) is not None


def test_sites_and_skin_come_from_info(plate: RemotePlate) -> None:
    assert plate.problem == ""
    assert plate.skin is not None
    np.testing.assert_array_equal(plate.skin.skin.site_positions_m, SITES_M)
    assert plate.skin.site_ids.tolist() == list(range(100, 100 + SITES))
    assert plate.skin.grid == info().grid
    skin = plate.skin.skin
    assert (skin.half_space.youngs_modulus_pascal, skin.half_space.poisson_ratio, skin.depth_m) == (2e5, 0.5, 1e-3)
    assert (skin.gain_std, skin.correlation_length_m, skin.tangential_ratio) == (0.0, 1e-3, 0.3)


def test_what_is_decoded_has_the_header_of_its_signals(plate: RemotePlate) -> None:
    message = plate.take_signals(encode(signals(7)), 1.0)
    assert message is not None
    sent = signals(7)
    assert header_of(message) == {
        "seq": 7,
        "daemon_boot_id": sent.daemon_boot_id,
        "board_boot_id": "51aa03c4",
        "t_ns": sent.t_ns,
        "t_unc_ns": 42_000,
        "lost": sent.lost,
        "board_ticks": 1007,
    }


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
def test_another_skin_is_noticed_and_the_same_one_is_not(plate: RemotePlate, change: dict[str, Any]) -> None:
    assert not plate.take_info(encode(info(daemon_version="0.2.0")))
    assert plate.take_info(encode(info(**change)))
    assert not plate.take_info(encode(info(**change)))


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        (b"", "no info yet"),
        (b"{}", "info cannot be read"),
        (b"\xff\xfe", "info cannot be read"),
        (encode(info(skin=None)), "has no skin"),
        (encode(info(schema_version="2.0")), "schema version '2.0', this decoder reads 1"),
        (encode(info(skin=SKIN.model_copy(update={"depth_m": 0.0}))), "depth"),
        (encode(info(skin=SKIN.model_copy(update={"gain_std": 1.0}))), "gain_std"),
        (encode(info(skin=SKIN.model_copy(update={"poisson_ratio": 0.7}))), "poisson_ratio"),
        (encode(info(sites=())), "no sites"),
    ],
)
def test_an_info_that_is_no_use_says_why(plate: RemotePlate, payload: bytes, problem: str) -> None:
    assert plate.take_info(payload)
    assert plate.skin is None
    assert problem in plate.problem
    assert not take(plate, encode(signals(0)))
    assert (plate.received, plate.unusable) == (1, 1)
    assert plate.take_info(encode(info()))
    assert take(plate, encode(signals(1)))


def test_a_minor_version_more_is_read(plate: RemotePlate) -> None:
    assert not plate.take_info(encode(info(schema_version="1.7")))
    assert plate.skin is not None


HOSTILE = [
    b"",
    b"{}",
    b"\xa0",
    b"\x9f" * 100_000,  # arrays in arrays
    b"\xd8\x28" * 10_000,
    encode(signals(0))[:-1],
    encode(signals(0)) + b"\x00",
    encode(signals(0, np.zeros((3, 4)), noise_std=np.ones((3, 4), np.float32))),
    encode(signals(0, np.zeros((3, 12, 12)), noise_std=np.ones((3, 12, 12), np.float32))),
    encode(signals(0, status="settling")),
    cbor2.dumps({"seq": "x" * 1000}),
    cbor2.dumps(cbor2.CBORTag(40, [[2**40, 2**40], cbor2.CBORTag(85, b"")])),
    cbor2.dumps(cbor2.CBORTag(2, b"\xff" * 10_000)),
]


@pytest.mark.parametrize("payload", HOSTILE, ids=range(len(HOSTILE)))
def test_what_is_no_frame_of_this_skin_is_counted(plate: RemotePlate, payload: bytes) -> None:
    assert not take(plate, payload)
    assert (plate.received, plate.unusable) == (1, 1)
    assert take(plate, encode(signals(0)))


def test_mutated_frames_never_raise(plate: RemotePlate) -> None:
    whole, rng, used = encode(signals(3)), random.Random(7), 0
    for _ in range(3000):
        payload = bytearray(whole)
        for _ in range(rng.randrange(1, 8)):
            payload[rng.randrange(200 if rng.random() < 0.7 else len(whole))] = rng.randrange(256)
        used += take(plate, bytes(payload[: rng.randrange(len(whole))] if rng.random() < 0.2 else payload))
    assert plate.received == 3000 == used + plate.unusable
    assert 0 < used < 3000


def test_gaps_of_one_daemon_are_missed_frames(plate: RemotePlate) -> None:
    for seq in (5, 6, 9, 9, 8, 10):  # 7 and 8 missing; 8 comes late, 9 twice
        take(plate, encode(signals(seq)))
    assert plate.missed == 2
    take(plate, encode(signals(0, boot="another")))
    take(plate, encode(signals(2, boot="another")))
    assert plate.missed == 3


def test_frames_that_cannot_be_used_do_not_count_as_signs_of_life(plate: RemotePlate) -> None:
    take(plate, b"")
    assert plate.last_s == -np.inf
    take(plate, encode(signals(0)))
    assert plate.last_s == 1.0
