"""Says everything that is wrong with a data set: `crowdmap check DATASET [--json FILE] [--html FILE] [--fix NEW]`.

What breaks FORMAT.md (all files, all journeys, all rows), and what looks wrong though it does not: each with its likely
cause and its cure. `--html` shows it beside pictures of the drives; `--fix` writes a new data set with all that put right
for which there is one cure, says what it changed, and checks that again. Exit codes: 0 nothing that stops or spoils a map
(of NEW, with `--fix`), 4 something; others as of every command.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from crowdmap_torch.checking.check import NOTE, SPOILS, STOPS, Check, Item, check_dataset
from crowdmap_torch.checking.repair import refuse_place, write_repaired
from crowdmap_torch.config import load_config
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.documents import write_json
from crowdmap_torch.io.errors import InputError, input_read
from crowdmap_torch.io.remote import Place, at_hand, place_of
from crowdmap_torch.processes.threads import one_core_each
from crowdmap_torch.report.check_json import check_content

FOUND = 4
"""Exit code where something stops or spoils a map."""
_TOLD = {
    STOPS: "stops the mapper: journeys, or the data set, are refused",
    SPOILS: "spoils the map: allowed by FORMAT.md, and probably a mistake",
    NOTE: "worth knowing",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap check` takes."""
    parser.add_argument(
        "dataset", type=place_of, metavar="DATASET", help="folder as in FORMAT.md or URL"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the findings here too")
    parser.add_argument(
        "--html", type=Path, metavar="FILE", help="write a page with findings and pictures here"
    )
    parser.add_argument(
        "--fix", type=Path, metavar="NEW", help="write a data set with mistakes put right here"
    )
    parser.add_argument("--config", type=Path, metavar="YAML", help="what `optimize` will be given")


def run(options: argparse.Namespace) -> int:
    """Prints what is found in `options.dataset`, and writes what is asked for; the exit code."""
    with input_read():
        _refuse_places(options)
        config = load_config(options.config)
        with one_core_each(), reading(config.reading), at_hand(options.dataset) as here:
            check = check_dataset(here, config)
            _show(options.dataset, check)
            mended = None
            if options.fix is not None and any(item.repairs for item in check.items):
                mended = write_repaired(here, options.fix, check, config)
            if options.html is not None:
                # Plots and report take a quarter of the time until a check begins, and are of use on a page alone.
                from crowdmap_torch.report.check import write_check_page

                write_check_page(options.html, here, check, config)
                print(f"page: {options.html}")
    if options.json is not None:
        write_json(options.json, check_content(options.dataset, check, options.fix, mended))
    if options.fix is not None:
        if mended is None:
            print(f"nothing to put right: {options.fix} is not written")
        else:
            told = "with" if mended.changes else "and nothing of it could be put right"
            print(f"{options.fix}: written anew, {told}")
            for line in mended.changes:
                print(f"  {line}")
            check = mended.check
            _show(options.fix, check)
    if check.is_sound:
        return 0
    grave = sum(item.severity != NOTE for item in check.items)
    place = options.fix if mended is not None else options.dataset
    print(
        f"{options.prog}: {place}: {grave} findings stop or spoil a map"
        if grave > 1
        else f"{options.prog}: {place}: a finding stops or spoils a map",
        file=sys.stderr,
    )
    return FOUND


def _refuse_places(options: argparse.Namespace) -> None:
    place = options.dataset
    if options.fix is not None:
        refuse_place(place, options.fix)
    for out in (options.json, options.html):
        if out is None:
            continue
        if out.is_dir():
            raise InputError(f"{out}: a folder; expected the name of a file")
        if isinstance(place, Path) and out.resolve().is_relative_to(place.resolve()):
            raise InputError(f"{out}: inside {place}; choose a place outside it")


def _show(place: Place, check: Check) -> None:
    used = len(check.dataset.journeys) if check.dataset is not None else 0
    print(f"{place}: {used} journeys can be used, {len(check.unseen)} have files that are refused")
    if not check.items:
        print("nothing found")
    for severity, told in _TOLD.items():
        items = [item for item in check.items if item.severity == severity]
        if items:
            print(f"\n{told}")
            _show_items(items)
    if check.unseen and not all(item.severity == NOTE for item in check.items):
        print(
            "\nof journeys that are refused the files alone were looked at; "
            "check again once they are mended"
        )


def _show_items(items: Sequence[Item]) -> None:
    for item in items:
        print(f"- {item.place}: {item.evidence}")
        print(f"  likely cause: {item.cause}")
        print(f"  cure: {item.cure}" + ("  [--fix does it]" if item.repairs else ""))
