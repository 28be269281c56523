"""One state machine of an RP2040's PIO, cycle by cycle: as much of the instruction set as a capture program uses."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

_LABEL = re.compile(r"(?:public )?(\w+):")
_INSTRUCTION = re.compile(r"(\w+)\s+(.*?)(?:\s*\[(\d+)\])?$")


@dataclass
class PioMachine:
    """State machine that runs the text of a `.pio` file; `pushed` has each word with its cycle.

    Parameters
    ----------
    program
        The file.
    pin
        Returns the level of the pin at a cycle.
    x, osr
        What was loaded before the start; y is loaded like osr.
    """

    program: Path
    pin: Callable[[int], bool]
    x: int
    osr: int
    cycle: int = 0
    isr: int = 0
    pushed: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.y = self.osr
        self._code: list[tuple[str, str, int]] = []
        self._labels: dict[str, int] = {}
        for line in self.program.read_text().splitlines():
            text = line.partition(";")[0].strip()
            if text == ".wrap_target":
                self._target = len(self._code)
            elif text == ".wrap":
                self._wrap = len(self._code) - 1
            elif label := _LABEL.fullmatch(text):
                self._labels[label[1]] = len(self._code)
            elif text and not text.startswith("."):
                found = _INSTRUCTION.fullmatch(text)
                assert found is not None, text
                self._code.append((found[1], found[2], int(found[3] or 0)))
        self._at = self._target

    def run(self, cycles: int) -> None:
        """Run until so many cycles have passed since the start."""
        while self.cycle < cycles:
            operation, operands, delay = self._code[self._at]
            following = self._target if self._at == self._wrap else self._at + 1
            if operation == "jmp":
                condition, label = operands.split()
                if self._holds(condition):
                    following = self._labels[label]
            elif operation == "mov":
                to, source = operands.split(", ")
                setattr(self, to, getattr(self, source))
            else:
                assert (operation, operands) == ("push", "noblock"), operation
                self.pushed.append((self.cycle, self.isr))
                self.isr = 0
            self._at = following
            self.cycle += 1 + delay

    def _holds(self, condition: str) -> bool:
        if condition == "pin":
            return self.pin(self.cycle)
        register = condition.removesuffix("--")
        before = getattr(self, register)
        setattr(self, register, (before - 1) % 2**32)
        return bool(before)
