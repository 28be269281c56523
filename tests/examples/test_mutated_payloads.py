"""Whatever arrives, the C examples read nothing that is not there: sound and damaged payloads, under sanitizers."""

import os
import subprocess
from pathlib import Path

import cbor2
import numpy as np
import pytest
from cbor2 import CBORTag
from example_programs import EXAMPLES, run
from published import decoded, event, force, forces

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import Grid

SANITIZERS = ("-std=c99", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
# Damaged sizes make libcbor ask for gigabytes; it lives with a refusal.
ENVIRONMENT = {**os.environ, "ASAN_OPTIONS": "allocator_may_return_null=1:max_allocation_size_mb=16"}
ARRAY = np.arange(27.0).reshape(3, 3, 3)
SOUND = {
    "forces": [encode(forces(1, force(7, 1.234), force(12, 0.5))), encode(event(2, "onset"))],
    "decoded": [
        encode(decoded(1, ARRAY, Grid(origin_m=(0.0, 0.0), pitch_m=4e-4))),
        encode(decoded(2, ARRAY.reshape(3, 9), None)),
    ],
}
LIBRARIES = {"forces": ["-lcjson"], "decoded": [EXAMPLES / "c" / "typed_array.c", "-lcbor"]}
PAYLOADS = 20_000
BYTES = ARRAY.astype("<f4").tobytes()
NO_ARRAYS = {
    "another tag than 40": CBORTag(41, [[3, 3, 3], CBORTag(85, BYTES)]),
    "another tag than 85": CBORTag(40, [[3, 3, 3], CBORTag(86, BYTES)]),
    "no tags": [[3, 3, 3], BYTES],
    "no pair": CBORTag(40, [[3, 3, 3]]),
    "no byte string": CBORTag(40, [[3, 3, 3], CBORTag(85, BYTES.hex())]),
    "a list of byte strings": CBORTag(40, [[3, 3, 3], CBORTag(85, [BYTES])]),
    "no multiple of 4 bytes": CBORTag(40, [[3, 3, 3], CBORTag(85, BYTES + b"1")]),
    "too many elements": CBORTag(40, [[3, 3], CBORTag(85, BYTES)]),
    "too few elements": CBORTag(40, [[3, 3, 4], CBORTag(85, BYTES)]),
    "a broken row": CBORTag(40, [[3, 4, 2], CBORTag(85, BYTES)]),
    "no shape": CBORTag(40, ["333", CBORTag(85, BYTES)]),
    "a negative size": CBORTag(40, [[3, -4, 3], CBORTag(85, BYTES)]),
    "a size of 0": CBORTag(40, [[3, 0, 3], CBORTag(85, b"")]),
    "9 components": CBORTag(40, [[9, 3], CBORTag(85, BYTES)]),
    "null": None,
}


def feed(tmp_path: Path, name: str, payloads: list[bytes], count: int) -> list[bytes]:
    """Let an example take so many payloads, these and then mutated ones; return what it prints."""
    run("gcc", *SANITIZERS, "-Dmain=example_main", "-c", EXAMPLES / "c" / f"{name}.c", "-o", tmp_path / "example.o")
    sources = (Path(__file__).with_name("mutated.c"), EXAMPLES / "c" / "subscriber.c", tmp_path / "example.o")
    run("gcc", *SANITIZERS, *sources, *LIBRARIES[name], "-lmosquitto", "-o", tmp_path / "mutated")
    files = [tmp_path / f"sound-{number}" for number in range(len(payloads))]
    for file, payload in zip(files, payloads, strict=True):
        file.write_bytes(payload)
    command = [tmp_path / "mutated", str(count), "1", *files]
    done = subprocess.run(command, capture_output=True, env=ENVIRONMENT, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout.splitlines()


@pytest.mark.parametrize("name", SOUND)
def test_mutated_payloads(tmp_path: Path, name: str) -> None:
    lines = feed(tmp_path, name, SOUND[name], PAYLOADS)
    assert len(lines) > PAYLOADS / 10  # many payloads still make sense
    assert len(set(lines)) > 100  # and say something else


def test_what_is_no_such_array_is_passed_over(tmp_path: Path) -> None:
    sound = {"seq": 1, "traction_pascal": CBORTag(40, [[3, 3, 3], CBORTag(85, BYTES)])}
    payloads = [
        cbor2.dumps({**sound, "seq": n, "traction_pascal": value}) for n, value in enumerate(NO_ARRAYS.values())
    ]
    chunk = cbor2.dumps(BYTES)
    payloads += [cbor2.dumps(sound).replace(chunk, b"\x5f" + chunk + b"\xff")]  # a byte string in pieces
    payloads += [cbor2.dumps({"seq": 1}), cbor2.dumps({**sound, "seq": "1"}), cbor2.dumps([1]), b"", cbor2.dumps(sound)]
    assert feed(tmp_path, "decoded", payloads, len(payloads)) == [b"mutated seq 1 peak 26 Pa at point 8"]
