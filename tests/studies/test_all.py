from __future__ import annotations

import pkgutil

from worlds.studied import turned

from crowdmap_torch import studies
from crowdmap_torch.studies.all import STUDIES
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_every_module_that_is_a_study_is_among_them():
    named = {study.name.replace("-", "_") for study in STUDIES}
    assert len(named) == len(STUDIES)
    assert named <= {module.name for module in pkgutil.iter_modules(studies.__path__)}


def test_a_study_of_which_nothing_is_done_has_a_chapter(settings: Settings, folder: StudyFolder):
    for study in STUDIES:
        assert study.chapter(settings, folder).text


def test_lower_turns_are_those_of_lower_seeds(settings: Settings):
    for study in STUDIES:
        turns: dict[tuple, list[tuple[int, float]]] = {}
        for turn, task in turned(study, settings):
            others = (getattr(task, name, None) for name in ("count", "config", "adjusted"))
            kind = (type(task), task.simulation.positioning, *others)
            turns.setdefault(kind, []).append((task.simulation.seed, turn))
        for found in turns.values():
            assert [t for _, t in sorted(found)] == sorted(t for _, t in found)
