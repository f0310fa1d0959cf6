"""The worked examples of CONTRIBUTING.md: each applies as it stands, and the tests that they bring pass."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PATCHES = sorted((ROOT / "docs" / "examples").glob("*.patch"))


def apply(patch: Path, folder: Path) -> None:
    """Applies a patch to a copy; an example that its reader has followed here is there already."""

    def git_apply(*options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["git", "apply", *options, "--unsafe-paths", f"--directory={folder}", str(patch)],
            cwd=folder.parent,
            capture_output=True,
            text=True,
            check=False,
        )

    if git_apply("--reverse", "--check").returncode == 0:
        return
    done = git_apply()
    assert done.returncode == 0, f"{patch.name} is out of date: {done.stderr}"


@pytest.fixture(scope="module")
def patched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository with all examples followed."""
    copy = tmp_path_factory.mktemp("examples") / "clone"
    copy.mkdir()
    for name in ("crowdmap_torch", "docs", "tests"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    for patch in PATCHES:
        apply(patch, copy)
    return copy


def test_every_example_is_explained():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    linked = re.findall(r"### .*\(docs/examples/(\w+)\.patch\)", page)
    assert sorted(linked) == [patch.stem for patch in PATCHES]


def test_the_examples_pass_their_own_tests(patched: Path):
    brought = {
        name
        for patch in PATCHES
        for name in re.findall(r"^\+\+\+ b/(tests/\S+)", patch.read_text("utf-8"), flags=re.M)
    }
    assert len(brought) == len(PATCHES)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *sorted(brought)],
        cwd=patched,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
