"""Tabular Q-learning reaches what value iteration gives, on a model of the game written down here."""

from dataclasses import replace
from itertools import product
from math import dist

import numpy as np
import pytest
import torch
from dqn_parts import q_table
from matrix_games import prisoners_dilemma

from cprl import CommonsEnv, Game, Observation, Rules, maps
from cprl.algorithms import Tabular
from cprl.envs import make_env, spaces_of
from cprl.learners.lanes import Lanes
from cprl.learners.settings import TabularSettings
from cprl.measuring.playing import evaluate
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.tabular import NEVER_MET, QTables
from cprl.training import Schedule, train

SEES_ALL = {"window_rows": 4, "window_columns": 7, "may_fire": False}
GAUGE = Observation(stock_gauge=True)

DEAD_END = maps.parse(">AA#\n###.")
"""An agent that looks away from a dead end knows from the stock gauge what hangs behind it, since the apples
can be bitten in one order alone. The closed-off cell to the right tells both ends apart."""

ONCE = Game(map=DEAD_END, rules=Rules(regrow_prob=(0.0,), episode_steps=30, **SEES_ALL), observation=GAUGE)
AGAIN = Game(
    map=DEAD_END, rules=Rules(regrow_prob=(0.0, 0.2), episode_steps=30, **SEES_ALL), observation=GAUGE
)
GAMMA = 0.9

ROW, COL = (-1, 0, 1, 0), (0, 1, 0, -1)
QUARTER_TURNS = {"forward": 0, "right": 1, "backward": 2, "left": 3}


def outcomes(game, state, action):
    """(chance, reward, next state or None) of an action, as docs/game.md tells the turn of one agent."""
    board, name = game.map, game.actions[action]
    row, col, heading, stock = state
    if name in QUARTER_TURNS:
        engine = (heading + QUARTER_TURNS[name]) % 4
        cell = row + ROW[engine], col + COL[engine]
        is_inside = 0 <= cell[0] < board.height and 0 <= cell[1] < board.width
        row, col = cell if is_inside and cell not in board.walls else (row, col)
    else:
        heading = (heading + {"turn_left": 3, "turn_right": 1, "stay": 0}[name]) % 4
    bitten = [bool(apple) and site == (row, col) for site, apple in zip(board.sites, stock, strict=True)]
    chances = []
    for site, apple in zip(board.sites, stock, strict=True):
        near = sum(n for other, n in zip(board.sites, stock, strict=True) if 0 < dist(site, other) <= 2)
        probs = game.rules.regrow_prob
        chances.append(0.0 if apple else probs[min(near, len(probs) - 1)])
    told = []
    for grown in product((0, 1), repeat=len(stock)):
        chance = np.prod([p if grows else 1 - p for p, grows in zip(chances, grown, strict=True)])
        left = tuple(int(n - b + g) for n, b, g in zip(stock, bitten, grown, strict=True))
        if chance > 0:
            told.append((float(chance), float(sum(bitten)), (row, col, heading, left) if sum(left) else None))
    return told


class Model:
    """All states that can be reached from the start, and what each action leads to."""

    def __init__(self, game, *, gamma=GAMMA):
        self.gamma = gamma
        row, col, heading = game.map.starts[0]
        self.start = row, col, heading, (1,) * len(game.map.sites)
        self.states, self.game = [self.start], game
        for state in self.states:  # which grows
            for action in range(len(game.actions)):
                for _, _, after in outcomes(game, state, action):
                    if after is not None and after not in self.states:
                        self.states.append(after)
        shape = len(self.states), len(game.actions)
        self.reward, self.chance = np.zeros(shape), np.zeros((*shape, len(self.states)))
        for n, state in enumerate(self.states):
            for action in range(shape[1]):
                for chance, reward, after in outcomes(game, state, action):
                    self.reward[n, action] += chance * reward
                    if after is not None:
                        self.chance[n, action, self.states.index(after)] += chance

    def best(self):
        """Value iteration: the optimal values of all actions, [states, A]."""
        values = np.zeros(len(self.states))
        for _ in range(400):
            values = (self.reward + self.gamma * self.chance @ values).max(1)
        return self.reward + self.gamma * self.chance @ values

    def of_policy(self, actions):
        """The value of each state for one who acts so, [states]."""
        every = np.arange(len(self.states))
        moves = np.eye(len(every)) - self.gamma * self.chance[every, actions]
        return np.linalg.solve(moves, self.reward[every, actions])


def true_states(env):
    now = env.worlds.now
    places = zip(now.row[:, 0], now.col[:, 0], now.heading[:, 0], now.stock, strict=True)
    return [(int(r), int(c), int(h), tuple(map(int, stock))) for r, c, h, stock in places]


def observed(agents):
    return [seen.tobytes() for seen in agents["observation"].numpy()[:, 0]]


def played(game, *, worlds, turns):
    """Each turn of random play: true states before and after, and as observed, actions, rewards, whether
    the world had ended, whether it has terminated."""
    env = CommonsEnv(game, worlds)
    moment = env.reset()
    for turn in range(turns):
        actions = torch.from_numpy(np.random.default_rng(turn).integers(len(game.actions), size=(worlds, 1)))
        before, seen, had_ended = true_states(env), observed(moment["agents"]), moment["done"][:, 0].tolist()
        moment["agents", "action"] = actions
        moment = env.step(moment)["next"]
        after, reward_kind = true_states(env), moment["agents", "reward"].flatten().tolist()
        terminated = moment["terminated"][:, 0].tolist()
        yield from zip(
            before, seen, actions[:, 0].tolist(), reward_kind, after, had_ended, terminated, strict=True
        )
        moment = moment.exclude(("agents", "reward"))


@pytest.fixture(scope="module", params=[ONCE, AGAIN], ids=["no regrowth", "regrowth"])
def known(request):
    """A game, its model, and what is observed in each of its states."""
    game = request.param
    rows = [row for row in played(game, worlds=1500, turns=29) if not row[5]]
    return game, Model(game), rows


def test_the_model_is_the_game_and_what_is_observed_tells_the_state(known):
    game, model, rows = known
    counts = {}
    for before, _, action, reward_kind, after, _, terminated in rows:
        outcome = reward_kind, None if terminated else after
        counts.setdefault((before, action), {}).setdefault(outcome, 0)
        counts[before, action][outcome] += 1
    assert {state for state, _ in counts} == set(model.states)
    assert len(counts) == model.reward.size
    for (state, action), seen in counts.items():
        told = {(reward, after): chance for chance, reward, after in outcomes(game, state, action)}
        assert set(seen) <= set(told), (state, action)
        tries = sum(seen.values())
        for outcome, chance in told.items():
            spread = 5 * (tries * chance * (1 - chance)) ** 0.5 + 1e-9
            assert abs(seen.get(outcome, 0) - tries * chance) <= spread, (state, action, outcome)
    pairs = {(state, seen) for state, seen, *_ in rows}
    assert len(pairs) == len({state for state, _ in pairs}) == len({seen for _, seen in pairs})


def learned(game, settings, *, episodes, replicas=2, seed=0):
    who = Lanes(game.spaces, agents=[0], replicas=replicas, seed=seed)
    learner = Tabular(settings=settings).make_learner(who)
    train(CommonsEnv(game, replicas, seed=seed), {(0,): learner}, Schedule(episodes=episodes))
    return learner


def table_by_state(learner, lane, model, rows):
    """The learned values of each state of the model, [states, A]."""
    table, seen_in = q_table(learner, lane), {state: seen for state, seen, *_ in rows}
    values = dict(zip(table["state"], table["values"], strict=True))
    return np.array([values[seen_in[state]] for state in model.states])


def shortfall(learner, lane, model, rows):
    """By what share of the highest value the learned policy falls short, in the worst of all states."""
    best = model.best().max(1)
    reached = model.of_policy(table_by_state(learner, lane, model, rows).argmax(1))
    return (best - reached).max() / best.max()


EXPLORES = {"gamma": GAMMA, "epsilon_end": 1.0}


@pytest.mark.integration
@pytest.mark.parametrize("known", [ONCE], ids=["no regrowth"], indirect=True)
def test_where_nothing_is_left_to_chance_it_learns_the_very_values(known):
    game, model, rows = known
    learner = learned(game, TabularSettings(learning_rate=1.0, **EXPLORES), episodes=80)
    for lane in range(2):
        np.testing.assert_allclose(table_by_state(learner, lane, model, rows), model.best(), atol=1e-6)
    assert model.best()[0].max() == pytest.approx(1 + GAMMA), "two steps, two apples"


@pytest.mark.integration
@pytest.mark.parametrize("known", [AGAIN], ids=["regrowth"], indirect=True)
def test_with_regrowth_its_policy_is_worth_what_value_iterations_is(known):
    game, model, rows = known
    settings = TabularSettings(learning_rate="1/visits", visits_power=0.7, **EXPLORES)
    learner = learned(game, settings, episodes=150)
    for lane in range(2):
        assert shortfall(learner, lane, model, rows) < 0.02
    on_the_first, one_left = (0, 1, 1, (0, 1)), model.states.index((0, 1, 1, (0, 1)))
    forward = game.actions.index("forward")
    assert model.best()[one_left].argmax() != forward, f"it pays to wait at {on_the_first}"


@pytest.mark.slow
def test_with_regrowth_it_learns_the_values_too():
    """Most of the time goes into unlearning what is too high: the highest of several noisy values is."""
    game = replace(AGAIN, rules=replace(AGAIN.rules, regrow_prob=(0.0, 0.9)))
    model, rows = Model(game, gamma=0.7), [row for row in played(game, worlds=1500, turns=29) if not row[5]]
    settings = TabularSettings(learning_rate="1/visits", visits_power=0.7, gamma=0.7, epsilon_end=1.0)
    learner = learned(game, settings, episodes=4000)
    best = model.best().max(1)
    for lane in range(2):
        values = table_by_state(learner, lane, model, rows).max(1)
        assert abs(values - best).max() < 0.05 * best.max()
        assert shortfall(learner, lane, model, rows) < 0.02


def learner_of(game, settings):
    learner = Tabular(settings=settings).make_learner(Lanes(game.spaces, agents=[0], replicas=1))
    learner.game = game
    return learner


def taught(learner, *names):
    """Plays a turn of one world after the other by the names of actions, and has each learned."""
    env = CommonsEnv(learner.game, 1)
    moment = env.reset()
    for name in names:
        moment["agents", "action"] = torch.tensor([[learner.game.actions.index(name)]])
        batch = env.step(moment)
        learner.store(batch)
        learner.update()
        moment = batch["next"].exclude(("agents", "reward"))
    return batch


def value_at_the_start(learner, name):
    return q_table(learner, 0)["values"][0, learner.game.actions.index(name)]


def test_what_comes_after_the_clock_counts_and_nothing_after_the_last_apple():
    settings = TabularSettings(learning_rate=1.0, gamma=0.5)
    rules = {"window_rows": 3, "window_columns": 1, "may_fire": False}
    short = Game(map=maps.parse("A>A"), rules=Rules(episode_steps=1, **rules))
    learner = learner_of(short, settings)
    taught(learner, "forward")  # Q(start, forward) = 1
    assert taught(learner, "stay")["next", "truncated"].item()
    assert value_at_the_start(learner, "stay") == 0.5

    # Who looks at the wall on the right sees the same whether the left apple hangs (X) or not (terminal).
    endless = Game(map=maps.parse("A>A"), rules=Rules(regrow_prob=(0.0,), **rules))
    learner = learner_of(endless, settings)
    for expected in (1.0, 1.0, 1.25):  # backward from X is worth 0, then 0.5 x 1, and so X itself
        taught(learner, "forward", "backward", "backward")
        assert value_at_the_start(learner, "forward") == expected
    batch = taught(learner, "backward", "forward", "forward")
    assert batch["next", "terminated"].item()
    assert value_at_the_start(learner, "forward") == 1.0, "1 + 0.5 x 0, not 1 + 0.5 x 0.5"


@pytest.mark.integration
def test_the_learned_policy_plays_through_its_evaluation_actor():
    learner = learned(ONCE, TabularSettings(learning_rate=1.0, **EXPLORES), episodes=40)
    ends = evaluate(CommonsEnv(ONCE, 6, seed=1), JointPolicy({(0,): learner.evaluation_actor(3)}))
    assert [(episode.steps, episode.harvest.sum()) for episode in ends] == [(2, 2.0)] * 6
    explored = evaluate(CommonsEnv(ONCE, 6), JointPolicy({(0,): learner.evaluation_actor(3)}), explore=True)
    assert len(explored) == 6


def test_the_table_of_an_agent_that_observes_floating_point_numbers_is_kept_as_a_network():
    env = make_env(prisoners_dilemma(turns=5), worlds=2)
    who = Lanes(spaces_of(env), agents=(0, 1), replicas=2)
    learner = Tabular(settings=TabularSettings(gamma=0.0, learning_rate=1.0)).make_learner(who)
    train(env, {(0, 1): learner}, Schedule(episodes=20))
    table, network = q_table(learner, 0), learner.networks()["replica_0/agent_0"]
    seen = torch.from_numpy(table["observation"])
    assert seen.dtype == torch.float32
    assert sorted(seen.argmax(-1).tolist()) == [0, 1, 2, 3, 4], "four joint actions, and none yet"
    assert np.array_equal(network(seen), table["values"])
    assert set(table["values"].ravel().tolist()) == {-3, -2, -1, 0}
    assert network(torch.full((1, 5), 0.5)).tolist() == [[0, 0]], "never met"


def test_more_states_than_are_allowed_are_refused():
    learner = learner_of(ONCE, TabularSettings(max_states=3))
    with pytest.raises(MemoryError, match="lane 0 has met 3 states, as many as max_states allows"):
        taught(learner, "turn_left", "turn_left", "turn_left", "turn_left", "forward")
    assert len(q_table(learner, 0)["values"]) == 3


def test_tables_grow_and_keep_what_they_hold():
    tables = QTables(2, 3, max_states=5000)
    states = [number.to_bytes(2, "big") for number in range(4000)]
    first = tables.find_or_add(states[:10], [0] * 10)
    tables.values[first] = np.arange(30).reshape(10, 3)
    tables.find_or_add(states, [1] * 4000)
    assert np.array_equal(tables.values[tables.find(states[:10], [0] * 10)], np.arange(30).reshape(10, 3))
    assert tables.find(states[10:12], [0, 1])[0] == NEVER_MET < tables.find(states[10:12], [0, 1])[1]
