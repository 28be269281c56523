"""Commands and programs of a page of documentation, in their order.

A block is one between fences, or indented by four. Blocks of shell and Python are run, others are data. An indented
block is shell if its first line begins with a command. Comments, which a reader of the built page does not see, stand
before a block:

- `<!-- run: COMMANDS -->` runs what the text asks the reader to do by hand, and what the page presumes.
- `<!-- file: NAME -->` saves the next block under this name.
- `<!-- not run: REASON -->` omits the next block, and `<!-- not run: "PART": REASON -->` each command with this part.
- `<!-- page not run: REASON -->` omits all of the page's blocks.
- `<!-- ended by the reader -->`: the next block prints until Ctrl-C.
- `<!-- exit code N: REASON -->`: a command of the next block may end with this code, too.
"""

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, replace

PROGRAMS = (
    r"resonatord|sudo|make|mosquitto\w*|python3?|cd|cmake|git|apt-get|systemctl|socat|openssl|pip|npx?|ros2|mkdir|docker|"
    r"sed|echo|cp|st-flash|\$"
)
COMMAND = re.compile(rf"(?:[A-Z_]+=\S+ )*(?:(?:\.venv|/opt|docs)/\S+|(?:{PROGRAMS})) ")
DIRECTIVES = ("run", "file", "not run", "page not run", "ended by the reader", "exit code")
DIRECTIVE = re.compile(rf" *<!--\s*((?:{'|'.join(DIRECTIVES)})(?: \d+)?)(?::\s*(.*?))?\s*-->", re.DOTALL)
ALWAYS_OMITTED = {"apt-get install": "packages of Debian"}


@dataclass(frozen=True)
class Step:
    """What a reader of a page does next."""

    line: int
    kind: str  # shell, python, file, not run
    text: str
    name: str = ""  # of the file; or the reason why it is not run
    hidden: bool = False
    ended_by_reader: bool = False
    exit_codes: tuple[int, ...] = ()


def steps(page: str) -> list[Step]:
    """Return the steps of a page: one for each command, each program and each file."""
    omitted, found, pending = dict(ALWAYS_OMITTED), [], Step(0, "", "")
    whole_page = ""
    for line, label, text in _parts(page):
        if label.startswith(DIRECTIVES):
            part = re.match(r'"([^"]+)": *(.*)', text, re.DOTALL)
            if label == "run":
                found += [Step(line, "shell", text, hidden=True)]
            elif label == "page not run":
                whole_page = text
            elif label == "not run" and part:
                omitted[part[1]] = part[2]
            elif label == "ended by the reader":
                pending = replace(pending, ended_by_reader=True)
            elif label.startswith("exit code"):
                pending = replace(pending, exit_codes=(int(label.split()[-1]),))
            else:
                pending = replace(pending, kind=label, name=text)
            continue
        kind = {"sh": "shell", "python": "python"}.get(label) or ("shell" if COMMAND.match(text) else "")
        if pending.kind == "file":
            found.append(replace(pending, line=line, text=text))
        elif kind:
            for command in _commands(text) if kind == "shell" else [text]:
                reason = pending.name or next((why for part_, why in omitted.items() if part_ in command), whole_page)
                own = replace(pending, line=line, text=command)
                found.append(replace(own, kind="not run", name=reason) if reason else replace(own, kind=kind))
        pending = Step(0, "", "")
    return found


def _commands(text: str) -> Iterator[str]:
    """Yield the commands of a block of shell, without comments; a comment `set KEY to "VALUE"` is done to the file."""
    lines = text.replace("\\\n", " ").splitlines()
    for line in [line for line in lines if line.startswith("$ ")] or lines:  # with a prompt: among its output
        command, _, comment = (part.strip() for part in line.removeprefix("$ ").partition(" # "))
        if (set_ := re.search(r'set (\w+) to ("[^"]*")', comment)) and (file := re.search(r"> *(\S+)$", command)):
            command += f" && sed -i 's|^{set_[1]} = .*|{set_[1]} = {set_[2]}|' {file[1]}"
        if command and not command.startswith("#"):
            yield command


def _parts(page: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, label and text of each block, and of each comment of the module's kinds."""
    lines = page.split("\n")
    number = 0
    while number < len(lines):
        begin, line = number, lines[number]
        number += 1
        if line.lstrip().startswith("<!--"):
            while "-->" not in lines[number - 1]:
                number += 1
            if found := DIRECTIVE.match("\n".join(lines[begin:number])):
                yield begin + 1, found[1], textwrap.dedent(found[2] or "")
        elif fence := re.match(r" *```(\w*)", line):
            while lines[number].strip() != "```":
                number += 1
            yield begin + 1, fence[1] or "text", textwrap.dedent("\n".join(lines[begin + 1 : number]))
            number += 1
        elif re.match(r" {4,}\S", line) and re.search(r"^\s*$|-->\s*$", lines[begin - 1]):
            while number < len(lines) and re.match(r" {4,}\S| *$", lines[number]):
                number += 1
            yield begin + 1, "", textwrap.dedent("\n".join(lines[begin:number])).strip()
