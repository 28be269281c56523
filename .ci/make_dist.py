"""Build wheel, source archive and bill of materials of the present commit in dist/: equal bytes for equal commits."""

import gzip
import io
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"


def git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True).stdout


def build(kind: str, source: Path, output: Path) -> Path:
    """Call one hook of the build backend; return the file that it made."""
    hook = f"from setuptools import build_meta; print(build_meta.build_{kind}({str(output)!r}))"
    done = subprocess.run([sys.executable, "-c", hook], cwd=source, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}make dist: {kind} failed")
    return output / done.stdout.split()[-1]


def reproducible(archive: Path, epoch: int) -> None:
    """Write a .tar.gz again: sorted, of user 0, and with one time for all its files."""
    content = io.BytesIO()
    with tarfile.open(archive) as old, tarfile.open(fileobj=content, mode="w", format=tarfile.PAX_FORMAT) as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            executable = member.isdir() or member.mode & 0o100
            member.mode, member.mtime = 0o755 if executable else 0o644, epoch
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    archive.write_bytes(gzip.compress(content.getvalue(), mtime=epoch))


def bill_of_materials(source: Path, output: Path) -> None:
    """Write the packages of `run.txt`, with versions and hashes, as CycloneDX."""
    tool = [sys.executable, "-W", "ignore", "-m", "cyclonedx_py", "requirements", ".ci/requirements/run.txt"]
    options = ["--pyproject", "pyproject.toml", "--output-reproducible", "--output-format", "JSON"]
    subprocess.run([*tool, *options, "--output-file", str(output)], cwd=source, check=True)


def main() -> None:
    epoch = int(git("log", "-1", "--format=%ct"))
    os.environ |= {"SOURCE_DATE_EPOCH": str(epoch), "TZ": "UTC", "LC_ALL": "C.UTF-8"}
    os.umask(0o022)
    DIST.mkdir(exist_ok=True)
    for old in DIST.glob("resonatord-*"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "source")
        with tarfile.open(fileobj=io.BytesIO(git("-c", "tar.umask=0022", "archive", "HEAD"))) as commit:
            commit.extractall(source, filter="tar")
        archive = build("sdist", source, DIST)
        reproducible(archive, epoch)
        with tarfile.open(archive) as unpacked:
            unpacked.extractall(folder, filter="tar")
        build("wheel", Path(folder, archive.name.removesuffix(".tar.gz")), DIST)
        bill_of_materials(source, DIST / archive.name.replace(".tar.gz", ".cdx.json"))
    sys.stdout.writelines(f"dist/{file.name}\n" for file in sorted(DIST.glob("resonatord-*")))


if __name__ == "__main__":
    main()
