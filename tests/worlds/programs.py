"""Small programs in processes of their own, and what they say; other states of the package that are small programs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120
"""For what takes a second at most: the machine may be busy."""


def begin(*arguments: str, **options) -> subprocess.Popen[str]:
    """A Python process with these arguments, what it says in pipes; it finds the package and the tests' worlds."""
    path = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
    given = {
        "cwd": ROOT,
        "env": {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"},
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True},
    }
    return subprocess.Popen([sys.executable, *arguments], **{**given, **options})


def checkout(folder: Path, main: str) -> Path:
    """Another state of the package, of which there is the main job alone."""
    package = folder / "crowdmap_torch"
    package.mkdir(parents=True)
    (package / "__main__.py").write_text(main)
    (package / "__init__.py").touch()
    return folder
