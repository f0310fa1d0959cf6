"""Packed tangents and the pattern of rows that an order of elimination rests on."""

from __future__ import annotations

from dataclasses import replace

import torch
from worlds.bordered_chains import drives

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.layout import SparsityPattern, layout


def test_unpacking_undoes_packing():
    group = torch.tensor([1, 0, 1])
    kinds = {"a": Variable(2, euclidean, group), "b": Variable(3, euclidean, group)}
    values = {"a": torch.randn(3, 2), "b": torch.randn(3, 3)}
    where = layout(Problem(kinds, {}, group_count=2), values)
    packed = where.pack(values)
    assert packed.shape == (2, 10) and not packed[0, 5:].any()
    for name, tangent in where.unpack(packed).items():
        assert torch.equal(tangent, values[name])


def rebuilt(problem: Problem) -> Problem:
    """The same rows in index tensors of their own."""
    terms = {
        name: replace(term, slots=tuple((slot, block.clone()) for slot, block in term.slots))
        for name, term in problem.terms.items()
    }
    return replace(problem, terms=terms)


def test_a_pattern_is_of_values_and_not_of_tensors():
    problem, values, _ = drives()
    pattern = SparsityPattern.of(problem, values)
    assert pattern.is_of(rebuilt(problem), values)
    changed = rebuilt(problem)
    changed.terms["sighting"].slots[1][1][3] += 1
    assert not pattern.is_of(changed, values)
    fewer = {name: term for name, term in problem.terms.items() if name != "start"}
    assert not pattern.is_of(replace(problem, terms=fewer), values)
    assert not pattern.is_of(problem, {**values, "mark": torch.cat([values["mark"]] * 2)})


def test_rows_changed_in_place_give_the_step_of_the_changed_problem():
    problem, values, plan = drives()
    backend, damping = ChainBackend(plan), torch.tensor([1e-3], dtype=torch.float64)
    backend.assemble(problem, values).solve(damping)
    mark = problem.terms["sighting"].slots[1][1]
    mark.copy_((mark + 1) % len(values["mark"]))
    ours, dense = (b.assemble(problem, values).solve(damping) for b in (backend, DenseBackend()))
    for name in values:
        torch.testing.assert_close(ours.delta[name], dense.delta[name], rtol=1e-8, atol=1e-10)


def test_a_problem_rebuilt_keeps_the_structure(monkeypatch):
    problem, values, plan = drives()
    backend = ChainBackend(plan)
    first = backend.assemble(problem, values).structure
    assert backend.assemble(rebuilt(problem), values).structure is first
    longer = CostTerm(lambda m: m, (("mark", torch.arange(len(values["mark"]))),))
    more = replace(problem, terms={**problem.terms, "prior": longer})
    assert backend.assemble(more, values).structure is not first
