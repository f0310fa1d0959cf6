"""Elimination along chains against the dense solve, on problems small enough for both."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from worlds.bordered_chains import assert_the_last_factors_serve_another_gradient

from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import rows
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers import chain_schur
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.elimination import planned_ahead
from crowdmap_torch.optim.solvers.normal_equations import ChainChanges
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.workspace import Workspace


def difference(x, y):
    return y - x


def prior(x, mean):
    return x - mean


def sighting(pose, landmark, measured):
    """A bearing-like, nonlinear sighting of a landmark from a pose."""
    offset = landmark - pose[:2]
    return torch.stack((torch.atan2(offset[1], offset[0]), offset.norm())) + pose[2] - measured


def pair_sighting(pose, first, second, measured):
    return (0.3 * first + 0.7 * second - pose[:2]) - measured


def problem(chain_lengths, landmarks=9, seed=0):
    """Chains of 2D poses with a common offset that see landmarks near them, as a Problem and start values."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape, scale=1.0):
        return scale * torch.randn(*shape, dtype=torch.float64, generator=generator)

    chain = torch.repeat_interleave(torch.arange(len(chain_lengths)), torch.tensor(chain_lengths))
    n = len(chain)
    step = torch.cat([torch.arange(length) for length in chain_lengths]).double()
    poses = torch.stack((step, 0.1 * noise(n), 0.1 * noise(n)), dim=-1)
    marks = torch.stack(
        (torch.linspace(0, max(chain_lengths), landmarks).double(), 3 + noise(landmarks)), dim=-1
    )
    distance = (poses[:, None, 0] - marks[None, :, 0]).abs()
    pose, mark = torch.nonzero(distance < 6, as_tuple=True)
    measured = torch.stack(
        [
            sighting(poses[p], marks[m], torch.zeros(2).double())
            for p, m in zip(pose, mark, strict=True)
        ]
    ) + noise(len(pose), 2, scale=0.01)
    measured[::17] += 2.0
    follows = torch.nonzero(chain[1:] == chain[:-1])[:, 0]
    second = (mark + 1) % landmarks
    pair = 0.3 * marks[mark] + 0.7 * marks[second] - poses[pose][:, :2]
    terms = {
        "prior": CostTerm(
            prior,
            (("pose", torch.arange(n)),),
            (poses + noise(n, 3, scale=0.1),),
            torch.full((n,), 2.0).double(),
        ),
        "odometry": CostTerm(
            difference,
            (("pose", follows + 1), ("pose", follows)),
            (),
            torch.full((len(follows),), 3.0).double(),
        ),
        "sighting": CostTerm(
            sighting,
            (("pose", pose), ("mark", mark)),
            (measured,),
            torch.full((len(pose),), 30.0).double(),
            Tukey(20.0),
        ),
        "pair": CostTerm(
            pair_sighting, (("pose", pose), ("mark", mark), ("mark", second)), (pair,), None
        ),
        "mark_prior": CostTerm(prior, (("mark", torch.arange(landmarks)),), (marks,), None),
    }
    variables = {"pose": Variable(3, euclidean), "mark": Variable(2, euclidean)}
    values = {
        "pose": poses + noise(n, 3, scale=0.1),
        "mark": marks + noise(landmarks, 2, scale=0.2),
    }
    return Problem(variables, terms), values, chain


def in_parts(plan: EliminationPlan, parts: int) -> EliminationPlan:
    """The plan with its chains in so many parts, in turns."""
    return replace(plan, part=torch.arange(plan.chain_count) % parts)


@pytest.mark.parametrize("lengths", [[1], [9], [10, 1, 9, 8], [85, 40], [19, 2, 33]])
@pytest.mark.parametrize(("group_size", "batch_bytes"), [(None, 1 << 22), (1, 1), (3, 2000)])
@pytest.mark.parametrize("parts", [1, 3])
def test_elimination_gives_the_dense_step(lengths, group_size, batch_bytes, parts):
    built, values, chain = problem(lengths)
    plan = in_parts(EliminationPlan("pose", chain), parts)
    backend = ChainBackend(plan, group_size, batch_bytes)
    chained, dense = (b.assemble(built, values) for b in (backend, DenseBackend()))
    torch.testing.assert_close(chained.cost, dense.cost)
    for damping in (1e-6, 1e-1, 1e3):
        damping = torch.tensor([damping], dtype=torch.float64)
        ours, theirs = chained.solve(damping), dense.solve(damping)
        for name in values:
            torch.testing.assert_close(ours.delta[name], theirs.delta[name], rtol=1e-8, atol=1e-10)
        torch.testing.assert_close(ours.predicted, theirs.predicted)
        torch.testing.assert_close(ours.norm, theirs.norm)


@pytest.mark.parametrize("lengths", [[1], [10, 1, 9, 8], [85, 40]])
@pytest.mark.parametrize("parts", [1, 3])
def test_the_last_factors_serve_another_gradient(lengths, parts):
    built, values, chain = problem(lengths)
    plan = in_parts(EliminationPlan("pose", chain), parts)
    assert_the_last_factors_serve_another_gradient(built, values, plan)


@pytest.mark.parametrize("lengths", [[1], [10, 1, 9], [85, 40]])
@pytest.mark.parametrize("parts", [1, 2])
def test_leaves_and_chain_give_the_dense_step(lengths, parts):
    built, values, chain = problem(lengths)
    n = len(chain)
    every = torch.arange(n)
    bound = CostTerm(
        difference, (("pose", every), ("drift", every)), (), torch.full((n,), 9.0).double()
    )
    terms = {
        name: replace(
            term, slots=tuple(("drift" if name == "odometry" else s, i) for s, i in term.slots)
        )
        for name, term in built.terms.items()
    }
    variables = {**built.variables, "drift": Variable(3, euclidean)}
    problem_with_leaves = Problem(variables, {**terms, "bound": bound})
    values = {**values, "drift": values["pose"] + 0.1}
    plan = in_parts(EliminationPlan("drift", chain, "pose", every), parts)
    backend = ChainBackend(plan, group_size=7)
    damping = torch.tensor([1e-3], dtype=torch.float64)
    ours = backend.assemble(problem_with_leaves, values).solve(damping)
    dense = DenseBackend().assemble(problem_with_leaves, values)
    theirs = dense.solve(damping)
    for name in values:
        torch.testing.assert_close(ours.delta[name], theirs.delta[name], rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(ours.predicted, theirs.predicted)


def test_a_block_of_the_chain_may_carry_several_leaves():
    built, values, chain = problem([30, 21], seed=4)
    n = len(chain)
    # One drift for every three poses of a chain.
    first = torch.cat((torch.tensor([True]), chain[1:] != chain[:-1]))
    rank = torch.arange(n) - torch.arange(n)[first][first.cumsum(0) - 1]
    begins = first | (rank % 3 == 0)
    carrier = begins.cumsum(0) - 1
    drift_chain = chain[begins]
    link = torch.nonzero(drift_chain[1:] == drift_chain[:-1])[:, 0]
    bound = CostTerm(
        difference,
        (("pose", torch.arange(n)), ("drift", carrier)),
        (),
        torch.full((n,), 9.0).double(),
    )
    terms = {
        **{name: term for name, term in built.terms.items() if name != "odometry"},
        "drift": CostTerm(difference, (("drift", link), ("drift", link + 1))),
        "bound": bound,
    }
    carried = Problem({**built.variables, "drift": Variable(3, euclidean)}, terms)
    values = {**values, "drift": values["pose"][begins] + 0.1}
    backend = ChainBackend(EliminationPlan("drift", drift_chain, "pose", carrier), group_size=3)
    damping = torch.tensor([1e-3], dtype=torch.float64)
    ours = backend.assemble(carried, values).solve(damping)
    theirs = DenseBackend().assemble(carried, values).solve(damping)
    for name in values:
        torch.testing.assert_close(ours.delta[name], theirs.delta[name], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("chunk", [1 << 22, 1 << 14])
def test_wide_windows_subtracted_run_by_run_give_the_dense_step(chunk):
    built, values, chain = problem([90, 80, 85], landmarks=120, seed=6)
    backend = ChainBackend(EliminationPlan("pose", chain), batch_bytes=chunk)
    damping = torch.tensor([1e-3], dtype=torch.float64)
    ours = backend.assemble(built, values).solve(damping)
    structure, _ = backend.prepare(built, values)
    batches = [b for part in structure.parts for of_round in part.rounds for b in of_round.batches]
    assert {batch.products is None for batch in batches} == {True, False}
    theirs = DenseBackend().assemble(built, values).solve(damping)
    for name in values:
        torch.testing.assert_close(ours.delta[name], theirs.delta[name], rtol=1e-8, atol=1e-10)


def test_marginal_covariance_is_the_block_of_the_dense_inverse():
    built, values, chain = problem([40, 25], seed=3)
    backend = ChainBackend(EliminationPlan("pose", chain))
    found = backend.assemble(built, values).covariance(floor=0.0)
    names = [name for name in built.variables if name != "pose"]
    at = torch.cat([found.where.entries(name, slice(None)).flatten() for name in names])
    marginal = found.solve(torch.eye(found.where.dim).double())[at][:, at]
    dense = DenseBackend().assemble(built, values)
    n = 3 * len(chain)
    torch.testing.assert_close(
        marginal, torch.linalg.inv(dense.hessian[0])[n:, n:], rtol=1e-7, atol=1e-12
    )


@pytest.mark.parametrize("lengths", [[1], [2], [10, 1, 9, 8], [85, 40], [19, 2, 33]])
@pytest.mark.parametrize("parts", [1, 2])
def test_block_covariances_are_those_of_the_dense_inverse_with_landmarks_held(lengths, parts):
    built, values, chain = problem(lengths, seed=4)
    backend = ChainBackend(in_parts(EliminationPlan("pose", chain), parts), group_size=5)
    found = backend.assemble(built, values).conditional_covariance("pose")
    n = len(chain)
    of_chains = DenseBackend().assemble(built, values).hessian[0, : 3 * n, : 3 * n]
    inverse = torch.linalg.inv(of_chains).view(n, 3, n, 3)
    every = torch.arange(n)
    torch.testing.assert_close(found, inverse[every, :, every], rtol=1e-8, atol=1e-12)


def test_both_back_ends_reach_the_same_minimum():
    built, values, chain = problem([30, 20], seed=1)
    config = lm.LmConfig(cost_tolerance=1e-12)
    ours = lm.solve(built, values, config, backend=ChainBackend(EliminationPlan("pose", chain)))
    theirs = lm.solve(built, values, config)
    assert ours.done
    torch.testing.assert_close(ours.cost, theirs.cost, rtol=1e-9, atol=0)
    torch.testing.assert_close(ours.values["mark"], theirs.values["mark"], rtol=0, atol=1e-6)


def test_what_is_eliminated_in_is_let_go(monkeypatch: pytest.MonkeyPatch):
    taken, take = [], Workspace.store

    def store(workspace: Workspace, rows: int) -> Tensor:
        found = take(workspace, rows)
        taken.append(weakref.ref(found))
        return found

    monkeypatch.setattr(Workspace, "store", store)
    built, values, chain = problem([9, 5])
    equations = ChainBackend(EliminationPlan("pose", chain)).assemble(built, values)
    equations.solve(torch.zeros(1).double())
    assert len(taken) == 1 and taken[0]() is None


def test_the_step_does_not_depend_on_the_order_of_rows():
    built, values, chain = problem([30, 20], seed=2)
    generator = torch.Generator().manual_seed(0)
    shuffled = {}
    for name, term in built.terms.items():
        shuffled[name] = rows(term, torch.randperm(len(term), generator=generator))
    damping = torch.tensor([1e-3], dtype=torch.float64)
    first = ChainBackend(EliminationPlan("pose", chain)).assemble(built, values).solve(damping)
    second = (
        ChainBackend(EliminationPlan("pose", chain))
        .assemble(Problem(built.variables, shuffled), values)
        .solve(damping)
    )
    for name in values:
        torch.testing.assert_close(first.delta[name], second.delta[name], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("width", [1, 3, 4, 5])
def test_rows_times_their_blocks(width: int):
    rows, blocks = torch.randn(20, width).double(), torch.randn(20, width, 6).double()
    expected = torch.einsum("fw,fwk->fk", rows, blocks)
    torch.testing.assert_close(chain_schur._rows_times(rows, blocks), expected)


def test_links_between_distant_blocks_are_refused():
    built, values, chain = problem([12])
    far = CostTerm(difference, (("pose", torch.tensor([0])), ("pose", torch.tensor([5]))))
    with pytest.raises(ValueError, match="neither neighbours"):
        ChainBackend(EliminationPlan("pose", chain)).assemble(
            Problem(built.variables, {**built.terms, "far": far}), values
        )


def test_a_chain_that_is_not_positive_definite_gives_a_failed_step_and_no_covariance():
    built, values, chain = problem([12, 7])
    normal = ChainBackend(EliminationPlan("pose", chain)).assemble(built, values)
    spoilt = normal.diagonal.clone()
    spoilt[5] = -spoilt[5]
    spoilt_normal = replace(normal, diagonal=spoilt)
    step = spoilt_normal.solve(torch.tensor([1e-6], dtype=torch.float64))
    assert not bool(step.solved)
    with pytest.raises(ValueError, match="not positive definite"):
        spoilt_normal.covariance()


def test_a_rank_that_is_given_changes_the_order_alone():
    built, values, chain = problem([10, 1, 9, 8])
    plan = EliminationPlan("pose", chain)
    rank = planned_ahead(built, values, plan).rank
    assert rank is not None
    given, other = (replace(plan, rank=r) for r in (rank, rank.flip(0)))
    damping = torch.tensor([1e-3], dtype=torch.float64)
    own, same, another = (
        ChainBackend(p).assemble(built, values).solve(damping) for p in (plan, given, other)
    )
    for name in values:
        assert torch.equal(own.delta[name], same.delta[name])
        torch.testing.assert_close(another.delta[name], own.delta[name], rtol=1e-8, atol=1e-10)


def moved_on(built: Problem, by: int) -> Problem:
    """The problem with every seventh row of a term gone over to another landmark."""
    term = built.terms["sighting"]
    (_, pose), (_, mark) = term.slots
    goes = (torch.arange(len(mark)) % 7 == 0) & (mark + by < 9)
    slots = (("pose", pose), ("mark", torch.where(goes, mark + by, mark)))
    return replace(built, terms={**built.terms, "sighting": replace(term, slots=slots)})


@pytest.mark.parametrize(("by", "keeps"), [(1, True), (4, False)])
def test_the_order_is_kept_while_rows_go_no_further_than_there_is_room(by: int, keeps: bool):
    built, values, chain = problem([10, 1, 9, 8])
    plan = planned_ahead(
        built,
        values,
        EliminationPlan("pose", chain),
        sliding={"mark": torch.zeros(9, dtype=torch.long)},
    )
    damping = torch.tensor([1e-3], dtype=torch.float64)
    backend = ChainBackend(plan)
    before, _ = backend.prepare(built, values)
    backend.assemble(built, values).solve(damping)
    later = moved_on(built, by)
    found = backend.assemble(later, values).solve(damping)
    after, _ = backend.prepare(later, values)
    assert (after.reduced is before.reduced) == keeps
    # Nothing of what came before is left: a run that is resumed ends with the same bits.
    fresh = ChainBackend(plan).assemble(later, values).solve(damping)
    dense = DenseBackend().assemble(later, values).solve(damping)
    for name in values:
        assert torch.equal(found.delta[name], fresh.delta[name])
        torch.testing.assert_close(found.delta[name], dense.delta[name], rtol=1e-8, atol=1e-10)
    back = backend.assemble(built, values).solve(damping)
    first = ChainBackend(plan).assemble(built, values).solve(damping)
    assert all(torch.equal(back.delta[name], first.delta[name]) for name in values)


def test_there_is_room_along_a_row_of_landmarks_and_none_for_the_next_row():
    built, values, chain = problem([10, 1, 9, 8])
    plan, count = EliminationPlan("pose", chain), len(values["mark"])
    _, mark = (block for _, block in built.terms["sighting"].slots)
    assert {2, 3} <= set(mark.tolist()) and count == 9
    none = planned_ahead(built, values, plan).room
    row = torch.tensor([0, 0, 0, 1, 1, 1, 1, 1, 1])
    room = planned_ahead(built, values, plan, sliding={"mark": row}).room
    assert none is not None and room is not None
    expected = {
        (pose, beside)
        for pose, own in ((key // count, key % count) for key in none.tolist())
        for beside in (own - 1, own, own + 1)
        if 0 <= beside < count and row[beside] == row[own]
    }
    assert {(key // count, key % count) for key in room.tolist()} == expected


def on_drift(
    built: Problem, values: Mapping[str, Tensor], chain: Tensor
) -> tuple[Problem, dict[str, Tensor]]:
    """The same poses, each a leaf that hangs on a drift of its own; the drifts are the chains."""
    n, every = len(chain), torch.arange(len(chain))
    weight = torch.full((n,), 9.0).double()
    bound = CostTerm(difference, (("pose", every), ("drift", every)), (), weight)
    moves = built.terms["odometry"]
    (_, after), (_, before) = moves.slots
    chained = replace(moves, slots=(("drift", after), ("drift", before)))
    terms = {**built.terms, "odometry": chained, "bound": bound}
    prior_of_drift = CostTerm(prior, (("drift", every),), (torch.zeros(n, 3).double(),), weight / 9)
    built = Problem(
        {**built.variables, "drift": Variable(3, euclidean)}, {**terms, "drift": prior_of_drift}
    )
    return built, {**values, "drift": torch.zeros(n, 3).double()}


def covariance_of(
    built: Problem, values: Mapping[str, Tensor], *names: str
) -> Float[Tensor, "n n"]:
    """Of all numbers of these variables, all others known: their rows and columns struck out."""
    dense = DenseBackend().assemble(built, values)
    at = torch.cat([dense.where.offset[name][:, None] + torch.arange(3) for name in names])
    return torch.linalg.inv(dense.hessian[0][at.flatten()[:, None], at.flatten()])


@pytest.mark.parametrize("leaves", [False, True])
@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("apart", [False, True])
def test_changes_along_drives_vary_as_the_dense_inverse_says(leaves: bool, parts: int, apart: bool):
    built, values, chain = problem([12, 7])
    plan = EliminationPlan("pose", chain)
    if leaves:
        built, values = on_drift(built, values, chain)
        every = torch.arange(len(chain))
        plan = EliminationPlan("drift", chain, "pose", every)
    normal = ChainBackend(in_parts(plan, parts)).assemble(built, values)
    normal.solve(torch.tensor([1e-12], dtype=torch.float64))
    # The last is between two chains, of one drive if they are not apart.
    pair = torch.tensor([[0, 5], [12, 15], [5, 11], [3, 14]])
    column = torch.tensor([0, 0, 1, 2] if apart else [0, 3, 1, 2])
    # The numbers of a block, and the first less the last.
    of = torch.cat((torch.eye(3), torch.tensor([[1.0], [0.0], [-1.0]])), dim=1).double()
    drive = torch.tensor([0, 1]) if apart else torch.zeros(2, dtype=torch.long)
    pair = pair[: 3 if apart else 4]
    whose = drive[chain[pair[:, 0]]]
    changes = ChainChanges(pair, column[: len(pair)], 4, whose, of, drive, 3)
    found = normal.variance_of_changes(changes)
    n = len(chain)
    dense = DenseBackend().assemble(built, values)
    at = (dense.where.offset[plan.chains][:, None] + torch.arange(3)).flatten()
    P = torch.linalg.inv(dense.hessian[0])[at[:, None], at].view(n, 3, n, 3)
    for k, (a, b) in enumerate(pair.tolist()):
        change = P[a, :, a] + P[b, :, b] - P[a, :, b] - P[b, :, a]
        expected = (of.T @ change @ of).diagonal()
        torch.testing.assert_close(found[k], expected, rtol=1e-6, atol=0)


def test_leaves_vary_about_what_carries_them_as_the_dense_inverse_says():
    built, values, chain = problem([12, 7])
    n = len(chain)
    built, values = on_drift(built, values, chain)
    plan = in_parts(EliminationPlan("drift", chain, "pose", torch.arange(n)), 2)
    found = ChainBackend(plan).assemble(built, values).variance_of_leaves()
    less = torch.cat((torch.eye(3 * n), -torch.eye(3 * n)), dim=1).double()
    P = covariance_of(built, values, "pose", "drift")
    expected = (less @ P @ less.T).diagonal().view(n, 3)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("told", [0.5, 1.0, 2.0])
def test_leaves_that_see_more_are_known_as_the_dense_inverse_says(told: float):
    built, values, chain = problem([12, 7])
    n = len(chain)
    built, values = on_drift(built, values, chain)
    plan = in_parts(EliminationPlan("drift", chain, "pose", torch.arange(n)), 2)
    found = ChainBackend(plan).assemble(built, values).conditional_covariance("pose", told=told)
    bound = {name: term for name, term in built.terms.items() if "drift" in dict(term.slots)}
    every, prior = (
        DenseBackend().assemble(replace(built, terms=terms), values).hessian[0]
        for terms in (built.terms, bound)
    )
    at = DenseBackend().assemble(built, values).where.offset
    rows = torch.cat([at[name][:, None] + torch.arange(3) for name in ("pose", "drift")]).flatten()
    hessian = (prior + told * (every - prior))[rows[:, None], rows]
    P, each = torch.linalg.inv(hessian)[: 3 * n, : 3 * n].view(n, 3, n, 3), torch.arange(n)
    torch.testing.assert_close(found, P[each, :, each], rtol=1e-8, atol=1e-12)
