"""A computer with systemd as PID 1, the host's own /usr, and resonatord installed in /opt: no image, no download."""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import psutil
import pytest

CHECKOUT = Path(__file__).parents[2]
RESONATORD = "/opt/resonatord/bin/resonatord"

_BOOT_S = 120.0
_LAUNCHER = f"""#!/opt/resonatord/bin/python
import sys
from resonator_daemon.commands import main
sys.argv[0] = "{RESONATORD}"
sys.exit(main())
"""
# As `pip install` would leave it, but for the files being those of the checkout and of its environment.
_PATHS = "/opt/checkout\nimport site; site.addsitedir('/opt/site-packages')\n"


def run_in_container(directory: Path, script: str, files: Mapping[str, str]) -> dict[str, str]:
    """Boot, run a shell script as root, power off; return what the script left in /out by name.

    Parameters
    ----------
    directory
        For the file system; empty.
    script
        Of bash; the first command that fails ends it, and the test.
    files
        Content by absolute path, put there before.
    """
    if os.geteuid() != 0:
        pytest.skip("only root may start a container")
    program = shutil.which("systemd-nspawn")
    if program is None:
        pytest.skip("systemd-nspawn is missing: `make test` installs it, or as root: apt-get install systemd-container")
    root, out = directory / "root", directory / "out"
    binds = _furnish(root, out)
    for path, content in files.items():
        _put(root / path.lstrip("/"), content)
    _put(out / "script", f"ldconfig\n{script}")
    boot = [program, "--quiet", f"--directory={root}", "--machine=resonatord-test", *binds, f"--bind={out}:/out"]
    boot += ["--boot", "--register=no", "--keep-unit", "--private-network", "--console=pipe"]
    boot += ["--", "--unit=test.target"]
    with subprocess.Popen(boot, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as nspawn:
        try:
            console, _ = nspawn.communicate(timeout=_BOOT_S)
        except subprocess.TimeoutExpired:
            for process in psutil.Process(nspawn.pid).children():
                process.kill()  # PID 1 in there, and with it all others, would outlive the one that started it
            console, _ = nspawn.communicate()
    found = {path.name: path.read_text(errors="replace") for path in out.iterdir() if path.is_file()}
    if "done" not in found:
        pytest.fail(
            f"the script ended early: {console.decode(errors='replace')}\n{found.get('stdout')}\n{found.get('stderr')}"
        )
    return found


def _furnish(root: Path, out: Path) -> list[str]:
    """Make the directories that /usr lacks; return the options that bring the rest."""
    for name in ("usr", "run", "tmp", "proc", "sys", "dev", "var/log/journal", "root", "out", "etc/systemd/system"):
        (root / name).mkdir(parents=True)
    out.mkdir()
    for name in ("bin", "sbin", "lib", "lib64"):
        (root / name).symlink_to(f"usr/{name}")
    for name in ("passwd", "group", "os-release"):
        shutil.copy(f"/etc/{name}", root / "etc" / name)
    _put(root / "etc/machine-id", "0123456789abcdef0123456789abcdef\n")
    for name in ("test.target", "test.service"):
        shutil.copy(Path(__file__).with_name(name), root / "etc/systemd/system")
    python, interpreter = Path(sys.base_prefix), Path(sys.base_prefix, "bin", f"python3.{sys.version_info.minor}")
    binds = ["--bind-ro=/usr", f"--bind-ro={CHECKOUT}:/opt/checkout"]
    binds += [f"--bind-ro={next(path for path in sys.path if path.endswith('site-packages'))}:/opt/site-packages"]
    if not python.is_relative_to("/usr"):
        binds.append(f"--bind-ro={python}:/opt/python")
        interpreter = Path("/opt/python") / interpreter.relative_to(python)
        _put(root / "etc/ld.so.conf", "/opt/python/lib\n")  # before a libpython that /usr may have
    environment = root / "opt/resonatord"
    site_packages = environment / f"lib/python3.{sys.version_info.minor}/site-packages"
    site_packages.mkdir(parents=True)
    (environment / "bin").mkdir()
    (environment / "bin/python").symlink_to(interpreter)
    _put(environment / "pyvenv.cfg", f"home = {interpreter.parent}\n")
    _put(environment / "bin/resonatord", _LAUNCHER)
    (environment / "bin/resonatord").chmod(0o755)
    _put(site_packages / "here.pth", _PATHS)
    return binds


def _put(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
