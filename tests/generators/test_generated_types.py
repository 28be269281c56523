"""Types that code generators make of the AsyncAPI document compile and read its examples without loss.

`make test-schema` installs the generators in build/generators; see generate.mjs.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from resonator_daemon.mqtt import asyncapi

pytestmark = pytest.mark.generators

HERE = Path(__file__).parent
TOOLS = HERE.parents[1] / "build" / "generators"
DOCUMENT = asyncapi.document()
MESSAGES = DOCUMENT["components"]["messages"]
EXAMPLES = {
    name: [example["payload"] for example in message["examples"]]
    for name, message in MESSAGES.items()
    if "examples" in message
}
(FORCES,) = EXAMPLES["Forces"]
UNKNOWN = dict.fromkeys(("force_newton", "noise_newton", "systematic_newton"))
OVERLOAD = FORCES | {"sites": [FORCES["sites"][0] | UNKNOWN | {"status": "overload", "at_least_newton": 10.0}]}


def run(*command: str | Path, folder: Path) -> str:
    environment = os.environ | {"GOCACHE": str(TOOLS / "go-cache"), "GOPROXY": "off", "GO111MODULE": "on"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what all generators made."""
    folder = tmp_path_factory.mktemp("generated")
    document = folder / "resonatord.asyncapi.json"
    document.write_bytes(asyncapi.encoded())
    run("node", HERE / "generate.mjs", document, folder, folder=TOOLS)
    return folder


def without_nulls(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_nulls(part) for key, part in value.items() if part is not None}
    return [without_nulls(part) for part in value] if isinstance(value, list) else value


def test_the_official_parser_finds_nothing_wrong(generated: Path) -> None:
    diagnostics = json.loads((generated / "diagnostics.json").read_text())
    error, warning = 0, 1
    assert [found for found in diagnostics if found["severity"] in (error, warning)] == []


def test_types_have_names(generated: Path) -> None:
    unnamed = [path.name for path in generated.rglob("*") if path.name.lower().startswith("anonymous")]
    assert unnamed == []
    types = (generated / "payloads.ts").read_text()
    assert not any(f"{name}1" in types for name in DOCUMENT["components"]["schemas"])


def test_types_in_go_keep_what_the_examples_say(generated: Path) -> None:
    folder = generated / "go"
    shutil.copy(HERE / "forces_test.go", folder)
    (folder / "go.mod").write_text("module messages\n\ngo 1.19\n")
    (folder / "overload.json").write_text(json.dumps(OVERLOAD))
    (folder / "examples.json").write_text(json.dumps(EXAMPLES))
    cases = "\n".join(f'\tcase "{name}":\n\t\treturn &{name}{{}}' for name in EXAMPLES)
    (folder / "new_message_test.go").write_text(
        f"package messages\n\nfunc newMessage(name string) any {{\n\tswitch name {{\n{cases}\n\t}}\n\tpanic(name)\n}}\n"
    )
    run("go", "build", "./...", folder=folder)
    run("go", "vet", "-structtag=false", "./...", folder=folder)  # modelina leaves a quote out in tags of unions
    run("go", "test", "./...", folder=folder)
    kept = json.loads((folder / "kept.json").read_text())
    for name, payloads in EXAMPLES.items():
        assert without_nulls(kept[name]) == without_nulls(payloads), name


def test_types_in_typescript_take_the_examples(generated: Path) -> None:
    shutil.copy(HERE / "forces.ts", generated)
    lines = [f"export const overload = {json.dumps(OVERLOAD)};"]
    for name, payloads in EXAMPLES.items():
        lines += [f'import type {{ {name} }} from "./payloads";']
        lines += [f'import type {{ {name} as {name}OfModelina }} from "./modelina/{name}";']
        for number, payload in enumerate(payloads):
            lines += [f"export const {name}_{number}: {name} = {json.dumps(payload)};"]
            lines += [f"export const {name}OfModelina_{number}: {name}OfModelina = {json.dumps(payload)};"]
    (generated / "examples.ts").write_text("\n".join(lines) + "\n")
    compiler = TOOLS / "node_modules" / ".bin" / "tsc"
    options = ("--strict", "--target", "es2022", "--module", "commonjs", "--outDir", "compiled")
    run(compiler, *options, "forces.ts", folder=generated)
    run("node", "compiled/forces.js", folder=generated)
