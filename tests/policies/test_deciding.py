"""Agents that decide: a bandit for each ballot, worked by hand; a vote that is learned; every road."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from random_agents import random_agents
from stock_collector import stock_collector
from stored_runs import episodes_of
from torchrl.envs.utils import ExplorationType, set_exploration_type

import cprl
from cprl import CommonsEnv, Custom, Experiment, Game, Rules, keys, maps
from cprl.algorithms import DQN, VDN, DQNSettings, Tabular, TabularSettings
from cprl.commands.recipe_command import parse_command
from cprl.envs.make_env import make_env
from cprl.evaluation.film import film_episode, record_episode
from cprl.evaluation.play import Session, open_session
from cprl.experimental.exhibition import policy_and_world
from cprl.institutions import Sanctioner, Tax, Vote
from cprl.institutions.votes import choice_of
from cprl.measuring.playing import evaluate, turns
from cprl.policies.decisions import UNTRIED, Bandit, BanditDecider, Decider, choices_of, decision_of
from cprl.policies.joint_policy import JointPolicy
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results
from cprl.training import Schedule, Training, train
from cprl.training.agents import Population
from cprl.training.evaluating import evaluate_population, random_play

RULES = Rules(
    regrow_prob=(0.0, 0.5), window_rows=3, window_columns=3, episode_steps=8, may_fire=False, freeze_steps=1
)
VOTE = Vote(on=Tax(), choices=(0.0, 1.0))
ONE_RICH = maps.parse("A>A#>#\nAAA#.#\nAAA###\nAAA#<#")
"""Agent 0 has a meadow to itself; agents 1 and 2 have none."""
TWO_RICH = maps.parse("A>A#A>A#>#\nAAA#AAA#.#")
"""Agents 0 and 1 have a meadow each; agent 2 has none."""
MEADOW = Game(
    map=maps.parse(".A>.A.A\nA.A...A\n..<.A>A"),
    rules=replace(RULES, may_fire=True, episode_steps=6, freeze_steps=2),
    institutions=(VOTE, Sanctioner()),
)
"""Three agents, who vote on a tax (2 choices) and elect who may fire (3): 6 options."""
TABLES = TabularSettings(epsilon_decay_steps=100, max_states=5000)
TABULAR = Learning(Tabular(settings=TABLES))
SOON = Bandit(epsilon_decay_episodes=8)
OWN = Experiment(
    name="deciding",
    game=MEADOW,
    agents=(replace(TABULAR, decisions=SOON), TABULAR, Scripted("greedy")),
    replicas=2,
    episodes=12,
    seed=3,
    evaluation_episodes=3,
    engine="eager",
    callbacks=(Custom("own_parts:Stopping"),),
)
ALLOW = ("own_parts:Stopping",)


def bandits(*own, sizes=(2, 3), stored=None, replicas=1, first_replica=0):
    return BanditDecider(
        sizes, bandits=own, stored=stored or {}, replicas=replicas, seed=5, first_replica=first_replica
    )


def learned(decider, *turns):
    """Learns from (decisions of all agents, returns of all agents) one after the other."""
    for decision, returns in turns:
        decider.learn(0, np.array(decision, np.int64), np.array(returns, np.float64))
    return decider


def by_chance():
    return random_agents(MEADOW.spaces, (0, 1, 2), replicas=1, seed=0)


def due(*rows):
    return torch.tensor(rows, dtype=torch.bool)


class Noting:
    """Keeps the episodes of a training."""

    def __init__(self):
        self.episodes = []

    def on_episode(self, episode, learning):
        self.episodes.append(episode)


def trained_for(steps, agents, *, worlds=2, engine="eager", transforms=(), **options):
    """The population of agents that were trained on the meadow, and the episodes that they played."""
    env, noting = make_env(MEADOW, worlds=worlds, seed=4, transforms=transforms), Noting()
    population = Population(env, agents, seed=6, engine=engine)
    options |= {"others": population.others, "decisions": population.decisions, "callbacks": [noting]}
    training = Training(env, population.learners, Schedule(episodes=1000), **options)
    training.start()
    for _ in range(steps):
        training.step()
    return population, noting.episodes


# ---- one number for all ballots


@given(st.lists(st.integers(2, 5), min_size=1, max_size=4), st.data())
def test_a_decision_is_one_number_for_the_choices_of_all_ballots(sizes, data):
    choices = np.array([data.draw(st.integers(0, size - 1)) for size in sizes])
    decision = decision_of(choices, sizes)

    class Ballots:
        options = sizes

    assert [choice_of(Ballots, ballot, int(decision)) for ballot in range(len(sizes))] == choices.tolist()
    assert choices_of(np.array([decision]), sizes).tolist() == [choices.tolist()]


# ---- what a bandit learns


def test_the_value_of_a_choice_is_the_mean_of_its_returns_until_the_step_is_as_small_as_it_gets():
    decider = bandits(Bandit(step_size=0.4), sizes=(2,))
    learned(decider, ([1], [4.0]))
    assert decider.values[0, 0].tolist() == [UNTRIED, 4.0]
    learned(decider, ([1], [8.0]))
    assert decider.values[0, 0, 1] == 4 + (8 - 4) / 2
    learned(decider, ([1], [1.0]))
    assert decider.values[0, 0, 1] == 6 + 0.4 * (1 - 6), "a third would be less than the step size"
    learned(decider, ([0], [-1.0]))
    assert decider.values[0, 0].tolist() == [-1.0, 4.0]


def test_each_ballot_is_learned_by_itself_and_each_agent_by_its_own_return_if_that_is_a_number():
    decider = bandits(Bandit(), Bandit())
    # Decision 5 is choice 1 of 2, then choice 2 of 3; decision 2 is choice 0, then choice 1.
    learned(decider, ([5, 2], [3.0, 7.0]))
    assert decider.values[0].tolist() == [
        [UNTRIED, 3.0, UNTRIED, UNTRIED, 3.0],
        [7.0, UNTRIED, UNTRIED, 7.0, UNTRIED],
    ]
    before = decider.values.copy()
    learned(decider, ([2, 5], [np.nan, np.nan]))
    assert (decider.values == before).all()


def test_exploration_decays_with_the_episodes_of_each_replica():
    decider = bandits(Bandit(epsilon_start=0.8, epsilon_end=0.2, epsilon_decay_episodes=3), replicas=2)
    seen = []
    for _ in range(5):
        seen.append(decider.epsilon[0, 0])
        learned(decider, ([0], [1.0]))
    assert np.allclose(seen, [0.8, 0.6, 0.4, 0.2, 0.2])
    assert decider.epsilon[1, 0] == 0.8


def test_the_best_choice_is_taken_and_of_equal_ones_the_first():
    values = torch.tensor([[2.0, 2.0, 1.0, 5.0, 5.0], [UNTRIED, -3.0, UNTRIED, UNTRIED, UNTRIED]])
    stored = {0: values[:1], 1: values[1:]}
    decider = Decider((2, 3), seeds=[(0,), (1,)], agents=2, stored=stored)
    # Agent 0: choices 0 and 1, so 0 + 2 x 1; agent 1: choices 1 and, of three that it never made, 0.
    assert decider.decide(due((True, True))).tolist() == [[2, 1]]


def test_agents_choose_anew_only_on_the_ballots_that_are_due():
    stored = {0: torch.tensor([[0.0, 1, 0, 0, 1]])}
    decider = Decider((2, 3), seeds=[(0,)], agents=1, worlds=2, stored=stored)
    assert decider.decide(due((True, False), (False, True))).tolist() == [[1], [4]]
    before = decider.decide(due((False, False), (False, False)))
    decider.values[0, 0] = [1, 0, 1, 0, 0]
    assert decider.decide(due((False, True), (False, False))).tolist() == [[1], [4]]
    assert decider.decide(due((True, True), (True, True))).tolist() == [[0], [0]]
    assert before.tolist() == [[1], [4]], "what was handed out never changes"


def test_agents_by_chance_make_every_choice_equally_often_whatever_the_exploration():
    decider = Decider((2, 3), seeds=[(0,), (1,)], agents=2, worlds=3000, stored={})
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found = decider.decide(torch.ones(3000, 2, dtype=torch.bool))
    for agent in range(2):
        shares = np.bincount(found[:, agent].numpy(), minlength=6) / 3000
        assert (abs(shares - 1 / 6) < 0.03).all(), shares  # 4 standard errors
    assert (found[:, 0] != found[:, 1]).any()


def test_an_agent_that_learns_explores_only_when_asked_to():
    decider = learned(bandits(Bandit(epsilon_start=1.0), sizes=(2,)), ([1], [1.0]))
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = {int(decider.decide(due([True]))) for _ in range(20)}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        best = {int(decider.decide(due([True]))) for _ in range(20)}
    assert (drawn, best) == ({0, 1}, {1})


def test_a_replica_decides_the_same_alone_as_beside_others():
    both, alone = bandits(Bandit(), replicas=2), bandits(Bandit(), first_replica=1)
    for turn in range(9):
        beside = both.decide(due((turn % 2 == 0,) * 2, (True, turn % 3 == 0)))
        assert beside[1].tolist() == alone.decide(due((True, turn % 3 == 0)))[0].tolist(), turn


# ---- the environment says which ballots are due


def test_ballots_are_due_before_the_first_turn_of_every_kth_episode():
    game = replace(MEADOW, institutions=(replace(VOTE, period_episodes=3), Sanctioner(period_episodes=2)))
    env = CommonsEnv(game, 2, seed=1)
    carried, seen = env.reset(), []
    for _ in range(4 * 6):
        seen.append(carried[keys.BALLOTS_DUE][0].tolist())
        _, carried = env.step_and_maybe_reset(env.rand_action(carried))
    firsts, later = seen[::6], [own for step, own in enumerate(seen) if step % 6]
    assert firsts == [[True, True], [False, False], [False, True], [True, False]]
    assert later == [[False, False]] * 20


def test_a_world_that_is_reset_alone_is_due_alone():
    env = CommonsEnv(MEADOW, 2, seed=1)
    stepped = env.step(env.rand_action(env.reset()))["next"].set("_reset", torch.tensor([[False], [True]]))
    assert env.reset(stepped)[keys.BALLOTS_DUE].tolist() == [[False, False], [True, True]]


# ---- a vote that is learned


@pytest.mark.integration
@pytest.mark.parametrize(("board", "majority", "choice"), [(ONE_RICH, (1, 2), 1), (TWO_RICH, (0, 1), 0)])
def test_a_majority_finds_the_tax_that_pays_it_more(board, majority, choice):
    game = Game(map=board, rules=RULES, institutions=(VOTE,))
    env = CommonsEnv(game, 4, seed=1)
    population = Population(env, (replace(TABULAR, decisions=Bandit(epsilon_decay_episodes=60)),) * 3, seed=2)
    train(env, population.learners, Schedule(episodes=120), decisions=population.decisions)
    best = population.decisions.best()[:, majority, 0]
    assert (best == choice).all(), population.decisions.values
    played = evaluate(CommonsEnv(game, 4, seed=9), population.policy(1), explore=True)
    assert all((episode.decision[list(majority)] == choice).all() for episode in played)


# ---- every road


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory):
    return cprl.run(OWN, tmp_path_factory.mktemp("whole") / "run", watch="off")


def test_the_table_of_episodes_says_what_each_agent_decided(in_one_go):
    table = read_episodes(in_one_go).to_pydict()
    assert set(table["decision"]) <= set(range(6))
    assert len(set(table["decision"])) > 2
    cprl.trust(*ALLOW)
    assert cprl.load(in_one_go).experiment == OWN


def test_agents_of_a_stored_run_decide_by_what_they_learned(in_one_go, tmp_path):
    exported = export_results(in_one_go, tmp_path / "small")
    cprl.trust(*ALLOW)
    loaded = cprl.load(exported)
    for replica in range(2):
        kept = [loaded.decisions[f"replica_{replica}/agent_{agent}"].numpy() for agent in (0, 1)]
        best = [int(own[:2].argmax() + 2 * own[2:].argmax()) for own in kept]
        found = cprl.evaluate_run(loaded, cprl.Fresh(episodes=8))
        trained = episodes_of(found, "decision", policy="trained")[replica]
        assert {tuple(decision[:2]) for decision in trained} == {tuple(best)}
        assert len({decision[2] for decision in trained}) > 1, "scripted: by chance"
        assert len(set(map(tuple, episodes_of(found, "decision", policy="random")[replica]))) > 4
    assert "replica_0/agent_2" not in loaded.decisions


@pytest.mark.parametrize("period", [1, 2])
def test_the_evaluation_after_a_training_begins_with_a_greedy_vote_and_random_play_is_by_chance(period):
    game = replace(MEADOW, institutions=(replace(VOTE, period_episodes=period),))
    experiment, env = replace(OWN, game=game, callbacks=()), make_env(game, worlds=2, seed=4)
    population = Population(env, experiment.agents, seed=6)
    population.decisions.values[:, :2] = [0.0, 1.0]
    before = random_play(experiment, population)
    assert {int(episode.decision[0]) for episode in before} == {0, 1}
    played = evaluate_population(experiment, env, population, random=before)["trained"]
    assert [episode.decision[:2].tolist() for episode in played] == [[1, 1]] * 6


@pytest.mark.integration
def test_runs_play_with_each_other_as_they_decide(in_one_go, tmp_path):
    other = cprl.run(replace(OWN, seed=8, callbacks=()), tmp_path / "other", watch="off")
    cprl.trust(*ALLOW)
    found = cprl.crossplay([in_one_go, other], cprl.Fresh(episodes=2))
    first, second = (cprl.load(run).policy(0).decisions.best()[0] for run in (in_one_go, other))
    cell = {"focal": in_one_go.name, "background": "other", "focal_agent": 1}
    for decision in episodes_of(found, "decision", **cell)[0]:
        decided = choices_of(np.array(decision), (2, 3))
        assert decided[0].tolist() == second[0].tolist()
        assert decided[1].tolist() == first[1].tolist()
    taxed = replace(OWN, game=replace(MEADOW, institutions=(VOTE,)), callbacks=(), episodes=1)
    with pytest.raises(ValueError, match=r"different games: Game\.institutions"):
        cprl.crossplay([other, cprl.run(taxed, tmp_path / "taxed", watch="off")])


@pytest.mark.integration
def test_films_and_people_who_play_have_decisions(in_one_go, tmp_path, monkeypatch):
    cprl.trust(*ALLOW)
    best = cprl.load(in_one_go).policy(0).decisions.best()[0]
    _, filmed = record_episode(in_one_go, tmp_path / "film.rrd")
    _, (drawn,) = film_episode(in_one_go, tmp_path / "film.gif")
    for episode in (filmed, drawn):
        assert choices_of(episode.decision, (2, 3))[:2].tolist() == best[:2].tolist()
    session = open_session(str(in_one_go), agent=1, decision=5)
    session.act("stay")
    assert session.turn == 1
    with pytest.raises(ValueError, match="decision is 6"):
        open_session(str(in_one_go), decision=6)
    with pytest.raises(ValueError, match="decision is 0"):
        open_session("single_basic", decision=0)
    open_session(str(in_one_go)).act("stay")


def test_a_person_who_decides_is_heard():
    env = make_env(replace(MEADOW, institutions=(VOTE,)), seed=1)
    rates = set()
    for decision in (0, 1):
        env.set_seed(1)
        stored = dict(enumerate(torch.tensor([[[0.0, 1.0]], [[1.0, 0.0]], [[0.0, 0.0]]])))
        decider = Decider((2,), seeds=[(0,)] * 3, agents=3, stored=stored)
        others = JointPolicy(by_chance(), decisions=decider)
        session = Session(env, others, agent=2, decision=decision)
        session.act("stay")
        rates.add((decision, float(env.worlds.law.ledger.in_force[0, 0])))
    assert rates == {(0, 0.0), (1, 1.0)}


def test_agents_of_an_earlier_run_decide_as_they_did_there(in_one_go, monkeypatch, tmp_path):
    monkeypatch.chdir(in_one_go.parent)
    frozen = [Frozen(in_one_go.name, agent, None) for agent in range(3)]
    cprl.trust(*ALLOW)
    loaded = cprl.load(in_one_go)
    population, _ = trained_for(13, frozen)
    for replica in range(2):
        best = loaded.policy(replica).decisions.best()[0, :2].tolist()
        assert population.decisions.best()[replica, :2].tolist() == best
    assert population.decisions.learned() == {}
    other = replace(MEADOW, institutions=(replace(VOTE, choices=(0.0, 0.5)), Sanctioner()))
    with pytest.raises(ValueError, match=r"have ballots \[\('the tax rate', \(0.0, 1.0\)\).*this game has"):
        Population(make_env(other), frozen)


def test_the_exhibition_decides_beside_the_training_and_leaves_it_alone():
    env = make_env(MEADOW, worlds=2, seed=4)
    population = Population(env, OWN.agents, seed=6)
    shown, world = policy_and_world(OWN, population)
    before = repr(population.decisions.state_dict())
    seen = [tuple(next(turns(world, shown))[keys.DECISION][0].tolist()) for _ in range(20)]
    assert len(set(seen)) > 4, "it explores as the training does"
    assert repr(population.decisions.state_dict()) == before
    population.decisions.values[0, :2] = [0.0, 1.0, 0.0, 0.0, 1.0]
    shown.is_trained = True
    seen = [next(turns(world, shown))[keys.DECISION][0, :2].tolist() for _ in range(5)]
    assert seen == [[5, 5]] * 5


REPLAY = DQNSettings(
    buffer_size=60, batch_size=4, learning_starts=4, hidden_cells=(4,), epsilon_decay_steps=50
)


@pytest.mark.integration
@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_engines_and_collectors_of_torchrl_have_the_same_decisions(engine):
    found, learning = [], (Learning(DQN(settings=REPLAY)),) * 3
    four_at_once = partial(stock_collector, steps=4)
    for steps, collector in ((24, None), (24, stock_collector), (6, four_at_once)):
        options = {"make_collector": collector} if collector else {}
        _, episodes = trained_for(steps, learning, engine=engine, **options)
        assert len(episodes) == 8
        found.append([episode.decision.tolist() for episode in episodes])
    assert found[0] == found[1], "the collector's first call, which it makes to look, draws nothing"
    assert found[0][:2] == found[2][:2]


@pytest.mark.integration
def test_transforms_and_teams_decide_too():
    scaled = Custom(
        "torchrl.envs.transforms:RewardScaling",
        arguments={"loc": 0.0, "scale": 0.5, "in_keys": [["agents", "reward"]]},
    )
    team = Team(VDN(settings=REPLAY), agents=(0, 2), decisions=Bandit(step_size=1.0))
    population, (*_, last) = trained_for(24, (team, Scripted()), transforms=[scaled])
    firsts = choices_of(last.decision, (2, 3))[:, 0]
    values = population.decisions.values[last.world, (0, 2), firsts[[0, 2]]]
    assert np.allclose(values, last.return_.sum()), "with a step of 1 the last return, which a team wants"


def test_decisions_are_learned_from_what_an_agent_wants():
    at_once = replace(TABULAR, decisions=Bandit(step_size=1.0))
    agents = (at_once, replace(at_once, reward="team"), Scripted("greedy"))
    population, (*_, last) = trained_for(12, agents, worlds=1)
    firsts = choices_of(last.decision, (2, 3))[:, 0]
    found = population.decisions.values[0, (0, 1), firsts[:2]]
    assert last.return_[0] != last.return_.sum()
    assert np.allclose(found, [last.return_[0], last.return_.sum()])


def test_decisions_are_given_where_they_are_asked_for_and_nowhere_else():
    with pytest.raises(ValueError, match=r"Bandit.step_size is 0"):
        Bandit(step_size=0)
    decider = Decider((3,), seeds=[(0,)], agents=1, stored={})
    with pytest.raises(ValueError, match="3 actors, and decisions of 1 agents"):
        JointPolicy(by_chance(), decisions=decider)
    env = make_env(MEADOW, worlds=1)
    population = Population(env, (Scripted(),) * 3)
    with pytest.raises(ValueError, match="decisions is None"):
        Training(env, {}, Schedule(episodes=1), others=population.others)
    plain = make_env(replace(MEADOW, institutions=()), worlds=1)
    alone = Population(plain, (Scripted(),) * 3)
    assert alone.decisions is None
    with pytest.raises(ValueError, match="decisions is a Decider"):
        Training(plain, {}, Schedule(episodes=1), others=alone.others, decisions=population.decisions)
    with pytest.raises(ValueError, match=r"agents\[0\].decisions is Bandit\(step_size=0.1.*allowed"):
        replace(OWN, game=replace(MEADOW, institutions=()))
    with pytest.raises(ValueError, match=r"agents\[1\].decisions is Bandit"):
        Population(plain, (Scripted(), replace(TABULAR, decisions=SOON), Scripted()))


def test_a_bandit_is_a_flag_of_the_command_line():
    experiment, _ = parse_command(lambda: OWN, ["recipe.py", "--agents.0.decisions.step-size", "0.3"])
    assert experiment.agents[0].decisions == replace(SOON, step_size=0.3)
