"""Games of a few strategies by how many play each: payoffs, equilibria, alpha-rank, replicator dynamics."""

from itertools import combinations
from math import comb
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from sharing_games import PowerWorth, SharingGame, herders

from cprl.experimental import solutions as needed
from cprl.experimental.empirical_game import _draw_simplex
from cprl.experimental.payoff_table import PayoffTable, compositions
from cprl.experimental.solutions import alpha_rank, equilibria, replicator, replicator_ends

DILEMMA = PayoffTable.from_pairs([[3, 0], [5, 1]])
STAG_HUNT = PayoffTable.from_pairs([[4, 0], [3, 1]])
CHICKEN = PayoffTable.from_pairs([[3, 1], [5, 0]])
ROCK_PAPER_SCISSORS = PayoffTable.from_pairs([[0, -1, 1], [1, 0, -1], [-1, 1, 0]])


def public_good(agents):
    """Strategy 0 gives: each gets 2 apples for every three that give, and who gives has paid 1."""
    counts = compositions(agents, 2)
    each = 2 / 3 * counts[:, :1]
    return PayoffTable(agents=agents, payoffs=np.hstack([each - 1, each]))


@pytest.fixture
def nashpy():
    return pytest.importorskip("nashpy")


@pytest.fixture
def open_spiel():
    return pytest.importorskip("open_spiel.python.egt.alpharank")


def sharing_table(game, levels):
    """A game of sharing in which agents choose among a few levels of what they take."""
    taken, counts = np.array(levels), compositions(game.agents, len(levels))
    payoffs = np.zeros(counts.shape)
    for row, players in enumerate(counts):
        played = np.repeat(np.arange(len(taken)), players)
        payoffs[row, played] = game.payoffs(taken[played])
    return PayoffTable(agents=game.agents, payoffs=payoffs)


def herders_at_levels(agents):
    """Levels with that of the equilibrium amid; the optimum is one of the others."""
    game = herders(agents)
    return sharing_table(game, [game.optimum_total / agents, game.nash_total / agents, 3 / agents])


def test_compositions_are_all_ways_once():
    assert compositions(2, 3).tolist() == [[2, 0, 0], [1, 1, 0], [1, 0, 1], [0, 2, 0], [0, 1, 1], [0, 0, 2]]
    found = compositions(5, 4)
    assert len(np.unique(found, axis=0)) == len(found) == comb(8, 3)
    assert (found.sum(1) == 5).all()


def test_a_matrix_is_the_game_of_two_agents():
    matrix = np.arange(9.0).reshape(3, 3) ** 2
    table = PayoffTable.from_pairs(matrix)
    assert table.pairs.tolist() == matrix.tolist()
    mixture = np.array([0.2, 0.5, 0.3])
    assert table.against(mixture) == pytest.approx(matrix @ mixture)


def test_what_one_gets_against_a_mixture_is_the_mean_over_the_others():
    # Of two others, each gives with 1/4: 2 x 1/4 give in the mean. Who gives gets 2/3 (1/2 + 1) - 1 = 0, who
    # does not 2/3 x 1/2 = 1/3.
    assert public_good(3).against([0.25, 0.75]) == pytest.approx([0, 1 / 3])
    # Where all give, who gives gets 2 - 1, and who does not 2/3 x 2.
    assert public_good(3).against([1, 0]) == pytest.approx([1, 4 / 3])
    assert public_good(3).pairs == pytest.approx(np.array([[1, -1 / 3], [4 / 3, 0]]))


def test_equilibria_of_compositions_are_those_that_nobody_leaves():
    assert DILEMMA.pure_equilibria == [(0, 2)]
    assert STAG_HUNT.pure_equilibria == [(2, 0), (0, 2)]
    assert CHICKEN.pure_equilibria == [(1, 1)]
    assert ROCK_PAPER_SCISSORS.pure_equilibria == []
    assert public_good(4).pure_equilibria == [(0, 4)]


def test_nashpy_finds_pure_and_mixed_equilibria(nashpy):
    def of(table):
        return [(own.first.tolist(), own.second.tolist()) for own in equilibria(table)]

    assert of(DILEMMA) == [([0, 1], [0, 1])]
    # Stag hunt: 4 p = 3 p + 1 - p for p = 1/2.
    assert of(STAG_HUNT) == [([1, 0], [1, 0]), ([0.5, 0.5], [0.5, 0.5]), ([0, 1], [0, 1])]
    # Chicken: 3 p + 1 - p = 5 p for p = 1/3; and one of each, once.
    found = equilibria(CHICKEN)
    assert [own.is_symmetric for own in found] == [False, True]
    assert found[1].first == pytest.approx([1 / 3, 2 / 3], abs=1e-6)
    assert found[0].support == (0, 1)
    (only,) = equilibria(ROCK_PAPER_SCISSORS)
    assert only.first == pytest.approx([1 / 3] * 3, abs=1e-6)


@pytest.mark.parametrize("agents", [2, 3])
def test_alpha_rank_and_nashpy_put_all_mass_on_the_herders_equilibrium(agents, open_spiel, nashpy):
    table = herders_at_levels(agents)
    assert alpha_rank(table).shares == pytest.approx([0, 1, 0], abs=1e-4)
    assert table.pure_equilibria == [(0, agents, 0)]
    symmetric = [own.first.tolist() for own in equilibria(table.reduced) if own.is_symmetric]
    assert symmetric == [[0, 1, 0]]
    if agents == 2:
        assert len(equilibria(table)) == 1


def test_equal_steps_of_what_herders_take_make_equilibria_that_are_none_of_the_game(nashpy):
    # Near the equilibrium the best answer to a step more is 0.6 of a step less, and the nearest level is a
    # whole one: one step up against one step down is an equilibrium of the levels beside that of the game.
    nash = herders(2).nash_total / 2
    table = sharing_table(herders(2), nash * np.array([0.5, 0.75, 1, 1.25, 1.5]))
    assert table.pure_equilibria == [(0, 1, 0, 1, 0), (0, 0, 2, 0, 0)]


def test_alpha_rank_of_games_worked_by_hand_without_a_warning(open_spiel):
    assert alpha_rank(ROCK_PAPER_SCISSORS).shares == pytest.approx([1 / 3] * 3)
    assert alpha_rank(DILEMMA).shares == pytest.approx([0, 1], abs=1e-5)
    # Where several compositions are almost never left each keeps its share.
    assert alpha_rank(STAG_HUNT).compositions == pytest.approx([0.5, 0, 0.5], abs=1e-4)
    assert alpha_rank(CHICKEN).compositions == pytest.approx([0, 1, 0], abs=1e-3)


def test_alpha_rank_of_more_agents_is_by_what_the_leaving_one_gains(open_spiel):
    assert alpha_rank(public_good(4)).shares == pytest.approx([0, 1], abs=1e-4)
    # Three agents, of whom one alone may do the work: who works gets 1, and where nobody does all get 0.
    counts = compositions(3, 2)
    works = np.where(counts[:, 0] == 1, 1.0, -1.0)
    idle = np.where(counts[:, 0] == 0, 0.0, 2.0)
    table = PayoffTable(agents=3, payoffs=np.stack([works, idle], 1))
    assert table.pure_equilibria == [(1, 2)]
    found = alpha_rank(table)
    assert found.compositions == pytest.approx([0, 0, 1, 0], abs=1e-4)
    assert found.shares == pytest.approx([1 / 3, 2 / 3], abs=1e-4)


def test_replicator_dynamics_follow_what_pays(open_spiel):
    # Shares 1/2: a cooperator gets 1.5, a defector 3, the mean is 2.25: 1/2 x (1.5 - 2.25).
    assert replicator(DILEMMA, [0.5, 0.5]) == pytest.approx([-0.375, 0.375])
    ends = replicator_ends(DILEMMA, starts=5)
    assert ends.mixtures == pytest.approx(np.array([[0, 1]]), abs=0.01)
    assert ends.shares.tolist() == [1.0]
    ends = replicator_ends(STAG_HUNT, starts=20)
    assert sorted(np.round(ends.mixtures).tolist()) == [[0, 1], [1, 0]], "by where one starts"
    assert replicator_ends(CHICKEN, starts=3).mixtures == pytest.approx(np.array([[1 / 3, 2 / 3]]), abs=1e-3)
    assert replicator_ends(ROCK_PAPER_SCISSORS, starts=1).unsettled == 1.0


def test_the_share_of_an_end_of_replicator_dynamics_is_not_written_over_the_name_of_its_corner():
    ends = SimpleNamespace(mixtures=np.eye(3), shares=[0.1, 0.2, 0.7])
    names = ["greedy", "restraint", "chance"]
    figure = Figure(figsize=(4, 4))
    axes = figure.add_subplot()
    _draw_simplex(axes, SimpleNamespace(mean=ROCK_PAPER_SCISSORS, ends=ends, names=names))
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [text.get_window_extent(renderer) for text in axes.texts]
    assert len(boxes) == 6
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


@pytest.mark.parametrize("gap", [0.2, 0.02, 0.001])
def test_replicator_dynamics_leave_a_dominated_strategy_however_slowly(gap):
    # Who plays the second strategy gets `gap` more whatever the other plays, of payoffs from 0 to 1 + gap.
    table = PayoffTable(agents=2, payoffs=np.array([[1.0, 0.0], [0.0, 1 + gap], [0.0, gap]]))
    ends = replicator_ends(table, starts=20)
    assert ends.unsettled == 0
    assert ends.mixtures == pytest.approx(np.array([[0.0, 1.0]]), abs=0.01)


def test_a_solver_that_fails_where_dynamics_have_come_to_rest_has_found_their_end(open_spiel, monkeypatch):
    class FailsAtRest:
        def __init__(self, *_, **__):
            self.y, self.status = np.array([0.5, 0.5]), "running"

        def step(self):
            assert self.status == "running"
            self.y, self.status = np.array([0.0, 1.0]), "failed"

    monkeypatch.setattr("scipy.integrate.LSODA", FailsAtRest)
    ends = replicator_ends(DILEMMA, starts=1)
    assert ends.unsettled == 0
    assert ends.mixtures.tolist() == [[0.0, 1.0]]


def test_equilibria_that_tie_but_for_rounding_are_all_told():
    # 30 (1 - 0.6) = 40 (1 - 0.7): beside one that takes 30, to take 30 or 40 pays the same.
    worth = PowerWorth(top=1.0, factor=0.01, power=1.0)
    table = sharing_table(SharingGame(agents=2, worth=worth, cost=0.0), [30, 40])
    assert table.pure_equilibria == [(2, 0), (1, 1)]


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: PayoffTable(agents=1, payoffs=np.zeros((2, 2))), "agents"),
        (lambda: PayoffTable(agents=3, payoffs=np.zeros((3, 2))), "payoffs"),
        (lambda: PayoffTable(agents=2, payoffs=np.full((3, 2), np.nan)), "payoffs"),
        (lambda: PayoffTable.from_pairs([[1, 2]]), "matrix"),
        (lambda: compositions(100, 100), "compositions"),
        (lambda: DILEMMA.against([0.5, 0.6]), "mixture"),
        (lambda: equilibria(public_good(3)), "table is of 3 agents"),
        (lambda: equilibria(PayoffTable.from_pairs(np.eye(7))), "7 strategies"),
        (lambda: alpha_rank(public_good(9)), "512 profiles"),
    ],
)
def test_what_is_no_game_is_refused(call, name):
    with pytest.raises(ValueError, match=name):
        call()


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr(needed, "find_spec", lambda name: None)
    for call in (lambda: equilibria(DILEMMA), lambda: alpha_rank(DILEMMA), needed.check_extras):
        with pytest.raises(ModuleNotFoundError, match=r'is not installed; run pip install "cprl\[theory\]"'):
            call()
