from __future__ import annotations

from crowdmap_torch.plausibility.finding import Finding, gathered

ODD = Finding("odd", "it hums", "a loose wire", "fix it")


def test_findings_of_one_kind_become_one_with_all_journeys_in_order() -> None:
    other = Finding("other", "it smells", "smoke", "run")
    found = gathered([("b", ODD), ("a", other), ("a", ODD), ("b", ODD)])
    assert [(f.kind, f.journeys) for f in found] == [("odd", ("b", "a")), ("other", ("a",))]


def test_a_line_names_three_journeys_and_counts_the_rest() -> None:
    (found,) = gathered([(name, ODD) for name in "abcde"])
    assert found.line(9) == "it hums (5 of 9 journeys: a, b, c and 2 more): a loose wire; fix it"
    assert ODD.line(9) == "it hums: a loose wire; fix it"
