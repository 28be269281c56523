"""Copy the pages of the repository to a folder that MkDocs builds: `python docs/site/stage.py FOLDER`.

Links lead from docs/ to pages beyond it, as PROTOCOL.md: MkDocs needs all of them below one folder.
"""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "docs/", "firmware_protocol/", "systemd/")
PACKAGE = [f"resonator_daemon.tools.python_api{module}" for module in (".recordings", ".tables", ".live", "")]
API = {
    "python-package": ("Python package resonatord", *PACKAGE),
    "python-elastic": ("Elastic half-space", "resonator_daemon.estimate.elastic"),
    "python-decoding": ("Decoders", "resonator_daemon.estimate.surface"),
}


def main(folder: Path) -> None:
    """Copy the tracked pages, their pictures and what they link to; write the pages made from docstrings."""
    shutil.rmtree(folder, ignore_errors=True)
    tracked = subprocess.run(["git", "ls-files", "-z", *PARTS], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, tracked.stdout.split("\0")):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, target)
    for page, (title, *modules) in API.items():
        text = "\n".join([f"# {title}\n", *(f"::: {module}\n" for module in modules)])
        (folder / "docs" / "reference" / f"{page}.md").write_text(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
