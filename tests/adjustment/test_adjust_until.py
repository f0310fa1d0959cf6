"""An adjustment is asked which landmarks there are before it has ended: what is left to do is done once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.adjust import Standing
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.footing import footing_of, stand_on
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.trees import digest
from crowdmap_torch.mapper import MapResult, build_bundle
from crowdmap_torch.optim.levenberg_marquardt import LmState
from crowdmap_torch.tables import Dataset

Said = tuple[str | None, int]


def built(tiny: Dataset, result: MapResult, config: MapperConfig | None = None) -> Bundle:
    return build_bundle(tiny.journeys, result.journey_maps, result.first, config or MapperConfig())


class Asked:
    """Answers with other landmarks at the `nth` question, and keeps after how many steps it was asked, ended or not."""

    def __init__(self, nth: int | None = None) -> None:
        self.nth, self.steps, self.asked = nth, 0, []
        self.kept: list[Standing] = []

    def __call__(self, ended: bool) -> Said:
        self.asked.append((self.steps, ended))
        number = len(self.asked)
        return ("others" if number == self.nth else None), number

    def told(self, bundle: Bundle, number: int, state: LmState) -> None:
        self.steps = number + 1
        standing = adjust.standing(bundle, state, self.steps)
        copied = {name: value.clone() for name, value in standing.bundle.items()}
        self.kept.append(Standing(standing.steps, standing.state, copied))

    def run(self, bundle: Bundle, standing: Standing | None = None) -> tuple[LmState, Said]:
        begun = adjust.start(bundle) if standing is None else adjust.go_on(bundle, standing)

        def told(number: int, state: LmState, _: adjust.Seen) -> None:
            self.told(bundle, number, state)

        self.steps = 0 if standing is None else standing.steps
        return adjust.adjust_until(bundle, begun, self, told=told, first=self.steps)


@pytest.fixture(scope="module")
def whole(tiny: Dataset, tiny_result: MapResult) -> tuple[Asked, Bundle, LmState, Said]:
    """An adjustment that was asked, and answered that all landmarks are as they are."""
    asked, bundle = Asked(), built(tiny, tiny_result)
    return asked, bundle, *asked.run(bundle)


def test_it_is_asked_a_step_after_detections_were_judged_and_at_the_end(whole):
    asked, _, state, said = whole
    judged = [int(standing.bundle["judged"]) for standing in asked.kept]
    first = next(number for number, times in enumerate(judged, 1) if times)
    assert asked.asked == [(first + 1, False), (len(judged), True)] and first + 1 < len(judged)
    assert state.done and said == (None, 2)


def test_questions_change_nothing(tiny, tiny_result: MapResult, whole):
    _, bundle, *_ = whole
    alone = built(tiny, tiny_result)
    assert adjust.adjust(alone).done
    assert digest(alone.state_dict()) == digest(bundle.state_dict())


def test_where_landmarks_are_others_it_goes_no_further(tiny, tiny_result: MapResult, whole):
    asked = Asked(nth=1)
    state, said = asked.run(built(tiny, tiny_result))
    assert asked.asked == whole[0].asked[:1] and said == ("others", 1)
    assert asked.steps == asked.asked[0][0] and not state.done


@pytest.mark.parametrize("behind", [0, 1])
def test_cut_where_it_was_asked_it_is_asked_again_and_behind_that_no_more(
    tiny, tiny_result: MapResult, whole, behind: int
):
    before, bundle, *_ = whole
    standing = before.kept[before.asked[0][0] - 1 + behind]
    again, other = Asked(), built(tiny, tiny_result)
    again.run(other, standing)
    assert again.asked == before.asked[behind:]
    assert digest(other.state_dict()) == digest(bundle.state_dict())


def test_one_that_begins_where_another_one_stood_is_asked_at_its_end_alone(
    tiny, tiny_result: MapResult, whole
):
    asked, again = Asked(), built(tiny, tiny_result)
    stand_on(again, footing_of(whole[1]))
    asked.run(again)
    assert [ended for _, ended in asked.asked] == [True]


def test_with_no_steps_left_it_has_ended(tiny, tiny_result: MapResult):
    few = replace(MapperConfig().adjust.lm, max_iterations=1)
    config = MapperConfig(adjust=replace(MapperConfig().adjust, lm=few))
    asked = Asked()
    state, _ = asked.run(built(tiny, tiny_result, config))
    assert asked.asked == [(1, True)] and not state.done
