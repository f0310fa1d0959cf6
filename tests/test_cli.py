"""The command line: what can be chosen, what is imported for it, and how it ends."""

from __future__ import annotations

import importlib
import pkgutil
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from worlds.programs import PATIENCE_S, begin

from crowdmap_torch import __version__, benchmark, studies
from crowdmap_torch.cli import COMMANDS, main
from crowdmap_torch.commands.benchmark import BENCHMARKS
from crowdmap_torch.commands.study import STUDIES

ROOT = Path(__file__).parents[1]


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """How a fresh interpreter ends."""
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"crowdmap {__version__}\n"


def test_nothing_chosen_is_wrong_input(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 2
    assert "NAME" in capsys.readouterr().err


def test_wrong_input_is_one_line_and_two(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    assert main(["benchmark", "association", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("crowdmap benchmark association: ") and error.count("\n") == 1


def test_what_the_program_gets_wrong_is_not_called_wrong_input(monkeypatch: pytest.MonkeyPatch):
    def mistaken(options: object) -> None:
        raise ValueError("a mistake of the program")

    monkeypatch.setattr("crowdmap_torch.benchmark.cluster.run", mistaken)
    with pytest.raises(ValueError, match="a mistake of the program"):
        main(["benchmark", "cluster"])


EARLY = """
import importlib.abc, os, signal, sys
import crowdmap_torch.cli as cli
number = signal.Signals(int(sys.argv[2]))

def come():
    os.kill(os.getpid(), number)

class Loading(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            come()
            print("loading went on", flush=True)

if sys.argv[1] == "options":
    cli.add_subcommands = lambda *parts: come()
else:
    sys.meta_path.insert(0, Loading())
sys.exit(cli.main(["optimize", "DATA", "--out", "RUN"]))
"""


@pytest.mark.parametrize(
    ("when", "out"),
    # torch aborts the process where an exception leaves its loading.
    [("options", ""), ("loading", "loading went on\n")],
)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_at_the_start_is_one_line(when: str, out: str, number, code: int):
    ended = python("-c", EARLY, when, str(int(number)))
    said = f"crowdmap: ended by {number.name}; nothing half-written is left\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (code, out, said)


def test_the_list_of_subcommands_loads_none_of_them():
    code = "import sys, crowdmap_torch.cli as cli; cli.main(['--help'])"
    ended = python("-X", "importtime", "-c", code)
    assert ended.returncode == 0 and "optimize" in ended.stdout
    assert "torch._C" not in ended.stderr and "numpy" not in ended.stderr


def test_what_only_the_papers_clustering_needs_is_not_loaded_before_it():
    code = "import sys, crowdmap_torch.mapper; print(*(m for m in sys.modules if m in LATE))"
    late = {"sklearn", "scipy.stats"}
    assert python("-c", code.replace("LATE", repr(late))).stdout.split() == []


def test_threads_are_told_to_sleep_before_torch_is_loaded():
    code = (
        "import os, sys, importlib.abc\n"
        "class Watch(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch': sys.exit(os.environ.get('OMP_WAIT_POLICY'))\n"
        "sys.meta_path.insert(0, Watch())\n"
        "from crowdmap_torch.cli import main\n"
        "main(['optimize', 'DATA', '--out', 'RUN'])\n"
    )
    assert python("-c", code).stderr.strip() == "PASSIVE"


@pytest.mark.parametrize("name", COMMANDS)
def test_scripts_are_commands(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    script = ROOT / "scripts" / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: crowdmap {name} ")


def test_the_package_is_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["-m", "--version"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("crowdmap_torch", run_name="__main__")
    assert stop.value.code == 0
    assert capsys.readouterr().out.startswith("crowdmap ")


def test_every_script_is_a_command():
    assert {path.stem for path in (ROOT / "scripts").glob("*.py")} == {*COMMANDS, "soak"}


@pytest.mark.parametrize(
    ("package", "names"), [(studies, STUDIES), (benchmark, BENCHMARKS)], ids=lambda p: None
)
def test_every_module_that_can_be_run_is_listed(package, names: dict[str, str]):
    modules = {
        module.name: importlib.import_module(f"{package.__name__}.{module.name}")
        for module in pkgutil.iter_modules(package.__path__)
        if not module.ispkg
    }
    runnable = {name for name, module in modules.items() if hasattr(module, "run")}
    assert runnable == {name.replace("-", "_") for name in names}


def test_a_full_disk_is_one_line_and_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def write(options: object) -> None:
        raise OSError(28, "No space left on device", "some/map")

    monkeypatch.setattr("crowdmap_torch.benchmark.cluster.run", write)
    assert main(["benchmark", "cluster"]) == 1
    error = capsys.readouterr().err
    assert error == (
        "crowdmap benchmark cluster: some/map: No space left on device; nothing half-written is left\n"
    )


def no_memory_of_python() -> None:
    raise MemoryError


def no_memory_of_torch() -> None:
    torch.empty(2**55, dtype=torch.uint8)


@pytest.mark.parametrize("lacking", [no_memory_of_python, no_memory_of_torch])
def test_too_little_memory_is_one_line_and_one(
    lacking: Callable[[], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("crowdmap_torch.benchmark.cluster.run", lambda options: lacking())
    assert main(["benchmark", "cluster"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("crowdmap benchmark cluster: not enough memory; nothing half-written")
    assert "--bbox" in error and error.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize(
    ("redirection", "code", "said"),
    [
        (">/dev/full", 1, "crowdmap calibrate: standard output: No space left on device\n"),
        (">&-", 0, ""),
        ("| true", 141, ""),
    ],
)
def test_work_is_done_though_nobody_can_read_what_is_printed(
    redirection: str, code: int, said: str, tmp_path: Path
):
    done = tmp_path / "done"
    program = (
        "import pathlib, sys, time, types\n"
        "from crowdmap_torch.cli import main\n"
        "chosen = sys.modules['crowdmap_torch.commands.calibrate'] = types.ModuleType('calibrate')\n"
        "chosen.add_arguments = lambda parser: None\n"
        "def run(options):\n"
        "    time.sleep(0.2)\n"
        "    print('figures')\n"
        f"    pathlib.Path({str(done)!r}).touch()\n"
        "chosen.run = run\n"
        "sys.exit(main(['calibrate']))\n"
    )
    ended = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f'"$0" -c "$1" {redirection}', sys.executable, program],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (code, said) and done.exists()


def test_a_signal_is_one_line_and_nothing_half_written_stays(tmp_path: Path):
    out = tmp_path / "dataset"
    program = (
        "import sys, crowdmap_torch.simulate.dataset as simulated\n"
        "from crowdmap_torch.cli import main\n"
        "write = simulated.files.write_truth\n"
        "def say(*arguments):\n"
        "    write(*arguments)\n"
        "    print('written', flush=True)\n"
        "simulated.files.write_truth = say\n"
        f"sys.exit(main(['simulate', {str(out)!r}, '--world', 'street', '--journeys', '400']))\n"
    )
    ended = begin("-c", program)
    assert ended.stdout is not None and ended.stdout.readline() == "written\n"
    ended.terminate()
    _, said = ended.communicate(timeout=PATIENCE_S)
    assert ended.returncode == 143
    assert said == "crowdmap simulate: ended by SIGTERM; nothing half-written is left\n"
    assert list(tmp_path.iterdir()) == []
