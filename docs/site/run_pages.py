"""Run the commands and programs of the documentation as they stand: `python docs/site/run_pages.py [PAGE...]`.

Each page is worked through in its order, in the checkout, with a broker at 127.0.0.1:1883. Each runs in namespaces of
its own: files that it writes, processes and ports disappear with it, and it has no network. Needs Linux with overlayfs,
and root or user namespaces. `docs/site/page_blocks.py` describes the comments with which a page prepares its commands.
"""

import argparse
import fcntl
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from page_blocks import Step, steps

ROOT = Path(__file__).parents[2]
PRELUDE = Path(__file__).with_name("page_shell.sh")
PYTHON = ROOT / ".venv" / "bin" / "python"
PRIVATE = ("/tmp", "/etc", "/opt", "/usr/local", "/var", "/run", "/root", "/home")
HOSTS = {"192.168.7.1": "robot", "192.168.7.2": "board", "192.168.7.3": "broker.example"}
COMMAND_S, READY_S = 240, 60

# Commands that last until they are stopped, what they print when they are ready, and whether a reader then ends them.
LASTING = {
    r"resonatord emulate\b.*&$": (r"emulating|\"link\"", False),
    r"resonatord emulate\b": (r"emulating|\"link\"", True),
    r"resonatord run\b": (r"sensor online|link (?:waiting|refused)", False),
    r"resonatord decode\s": (r"online", False),
    r"resonatord watch\b": (r": daemon online|^\{", True),
    r"resonatord (?:view|bridge)\b": (r"://|connected", True),
    r"examples/python/forces\.py": (r".", True),
    r"examples/c/decoded": (r"", True),
    r"mosquitto_sub\b(?!.* -C)": (r".", True),
}


class PageError(Exception):
    """A command of a page that does not do what the page promises."""


class Page:
    """One page in its namespaces: the processes that it started, its directory and its search path."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._cwd, self._path = str(ROOT), f"{ROOT}/.venv/bin:{os.environ['PATH']}:/usr/sbin:/sbin"
        self._lasting: list[tuple[subprocess.Popen[bytes], str]] = []

    def run(self, step: Step) -> None:
        """Run one command or program; of one that lasts, wait until it is ready."""
        text = step.text if step.hidden else step.text.removesuffix("&").strip()
        command = [str(PYTHON), "-c", text] if step.kind == "python" else ["bash", "-c", self._script(text)]
        visible = step.kind == "shell" and not step.hidden
        rules = [rule for pattern, rule in LASTING.items() if visible and re.search(pattern, step.text)]
        if step.ended_by_reader:
            rules = [(".", True)]
        output = self._folder / "output"
        with output.open("wb") as writer:
            process = subprocess.Popen(
                command, cwd=self._cwd, env=self._environment(), stdin=subprocess.DEVNULL, stdout=writer, stderr=writer,
                start_new_session=True,
            )  # fmt: skip
        if rules:
            ready, ended = rules[0]
            self._wait(process, output, ready)
            if ended:
                os.killpg(process.pid, signal.SIGINT)
            else:
                self._lasting.append((process, text))
                output.rename(self._folder / f"output-{process.pid}")
                return
        try:
            code = process.wait(COMMAND_S)
        except subprocess.TimeoutExpired:
            raise PageError(f"not done after {COMMAND_S} s: {tail(output)}") from None
        interrupted = rules and not text.startswith("resonatord") and code in (1, 130, -signal.SIGINT)
        if code not in (0, *step.exit_codes) and not interrupted:
            raise PageError(f"exit code {code}: {tail(output)}")
        if step.kind == "shell" and (state := self._folder / "state").exists():
            self._cwd, self._path = state.read_text().splitlines()
        for lasting, text in self._lasting:
            if lasting.poll():
                raise PageError(f"`{text}` has ended with {lasting.returncode}")

    def _script(self, text: str) -> str:
        return f'. {PRELUDE}\n{text}\ncode=$?\nprintf "%s\\n" "$PWD" "$PATH" > {self._folder}/state\nexit $code'

    def _environment(self) -> dict[str, str]:
        kept = {
            name: os.environ[name]
            for name in ("HOME", "LANG", "TERM", "PIP_NO_INDEX", "PIP_FIND_LINKS")
            if name in os.environ
        }
        return kept | {"PATH": self._path, "USER": "root", "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}

    @staticmethod
    def _wait(process: subprocess.Popen[bytes], output: Path, ready: str) -> None:
        end = time.monotonic() + READY_S
        while not re.search(ready, output.read_text(errors="replace"), re.MULTILINE):
            if process.poll() is not None or time.monotonic() > end:
                raise PageError(f"not ready: {tail(output)}")
            time.sleep(0.05)


def tail(output: Path) -> str:
    """Return the last lines of an output."""
    return "\n      ".join(output.read_text(errors="replace").splitlines()[-6:])


def work_through(name: str) -> int:
    """Run the steps of a page, in this process's namespaces; print what failed, and a line for the page."""
    begin, failed, count = time.monotonic(), 0, 0
    with tempfile.TemporaryDirectory() as folder, broker(Path(folder)):
        page = Page(Path(folder))
        for step in steps((ROOT / name).read_text()):
            if step.kind == "file":
                (ROOT / step.name).write_text(step.text)
            elif step.kind != "not run":
                count += not step.hidden
                try:
                    page.run(step)
                except PageError as error:
                    failed += 1
                    print(f"{name}:{step.line}: {step.text.splitlines()[0]}\n      {error}", flush=True)
    omitted = sum(step.kind == "not run" for step in steps((ROOT / name).read_text()))
    verdict = f"{failed} FAILED" if failed else "ok"
    print(f"{name}: {count} run, {omitted} not run, {time.monotonic() - begin:.0f} s: {verdict}", flush=True)
    return failed


@contextmanager
def broker(folder: Path) -> Iterator[None]:
    """Run Mosquitto at its usual port."""
    settings = folder / "mosquitto.conf"
    settings.write_text("listener 1883 127.0.0.1\nlistener 1883 192.168.7.1\nallow_anonymous true\nuser root\n")
    program = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        raise SystemExit("needs Mosquitto: apt-get install mosquitto mosquitto-clients")
    with subprocess.Popen([program, "-c", str(settings)], stderr=subprocess.DEVNULL) as process:
        yield
        process.kill()


def isolate() -> None:
    """Cover the directories of this namespace with private layers; give the loopback interface its addresses."""
    layers = Path("/mnt")
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", layers], check=True)
    covered = [Path(name) for name in PRIVATE if Path(name).is_dir()]
    for number, directory in enumerate([*covered, *([] if any(map(ROOT.is_relative_to, covered)) else [ROOT])]):
        upper, work = layers / f"{number}" / "upper", layers / f"{number}" / "work"
        upper.mkdir(parents=True)
        work.mkdir()
        options = f"lowerdir={directory},upperdir={upper},workdir={work}"
        subprocess.run(["mount", "-t", "overlay", "overlay", "-o", options, directory], check=True)
    os.chdir(ROOT)  # that of the new layer
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, 0x8914, struct.pack("16sh14x", b"lo", 1 | 64))  # SIOCSIFFLAGS: up, running
        for number, address in enumerate(HOSTS, 1):
            packed = struct.pack("16sHH4s8x", f"lo:{number}".encode(), socket.AF_INET, 0, socket.inet_aton(address))
            fcntl.ioctl(control, 0x8916, packed)  # SIOCSIFADDR
    with Path("/etc/hosts").open("a") as hosts:
        hosts.writelines(f"{address} {name}\n" for address, name in HOSTS.items())
    for stand_in in ("sudo", "systemctl"):
        shutil.copy(PRELUDE.with_name(f"stand_in_{stand_in}.sh"), f"/usr/local/bin/{stand_in}")


def in_namespaces(name: str) -> subprocess.CompletedProcess[str]:
    """Work through a page in namespaces of its own."""
    unshare = ["unshare", "--mount", "--pid", "--net", "--fork", "--kill-child", "--mount-proc"]
    own = [] if os.geteuid() == 0 else ["--map-root-user"]
    command = [*unshare, *own, str(PYTHON), __file__, "--inside", name]
    return subprocess.run(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)


def download_wheels() -> None:
    """Fetch what a page installs, because pages have no network."""
    folder = ROOT / "build" / "wheels"
    lists = [word for name in ("build", "run") for word in ("-r", str(ROOT / ".ci" / "requirements" / f"{name}.txt"))]
    pip = [str(PYTHON), "-m", "pip", "download", "-qq", "--disable-pip-version-check", "--no-deps", "--require-hashes"]
    subprocess.run([*pip, *lists, "--dest", str(folder)], check=True)
    os.environ |= {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(folder), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def documented() -> list[str]:
    """Return the pages of the repository that have a command or a program."""
    listed = subprocess.run(
        ["git", "ls-files", "README.md", "CONTRIBUTING.md", "docs/*.md"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [name for name in listed.stdout.splitlines() if (ROOT / name).exists() and steps((ROOT / name).read_text())]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("page", nargs="*", help="default: all")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--list", action="store_true", help="print what is not run, and why")
    arguments = parser.parse_args()
    if arguments.inside:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        isolate()
        return work_through(*arguments.page)
    pages = arguments.page or documented()
    if arguments.list:
        for name in pages:
            for step in steps((ROOT / name).read_text()):
                if step.kind == "not run":
                    print(f"{name}:{step.line}: {step.text.splitlines()[0]}\n      {step.name}")
        return 0
    if any("pip install ." in (ROOT / name).read_text() for name in pages):
        download_wheels()
    failed = []
    with ThreadPoolExecutor(2) as pool:
        for name, done in zip(pages, pool.map(in_namespaces, pages), strict=True):
            print(done.stdout, end="", flush=True)
            failed += [name] * (done.returncode != 0)
    print(f"{len(pages)} pages, {len(failed)} with failures" + "".join(f"\n  {name}" for name in failed))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
