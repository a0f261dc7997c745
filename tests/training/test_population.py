"""A population seats learners, scripted and frozen agents in any mix, and each learns as it would alone."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from dqn_parts import changed, make_learner, q_table
from small_learners import ALGORITHMS, FOUR, GAME, REPLAY, population, ran, trained, weights

import cprl
from cprl import CommonsEnv, Observation
from cprl.algorithms import DQN, Tabular
from cprl.algorithms.base import OffPolicy
from cprl.evaluation import Fresh, evaluate_run
from cprl.learners.replay import Replay
from cprl.learners.rollouts import Rollouts
from cprl.learners.settings import DQNSettings, TabularSettings
from cprl.networks.agent import acting_network
from cprl.population import Frozen, Learning, Scripted
from cprl.training import Schedule, train

UPDATES = dict.fromkeys(ALGORITHMS, "stacked") | {"SAC": "vmapped", "IQL": "vmapped"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_loss_takes_the_fastest_way_that_agrees_with_a_list_of_torchrls_losses(name):
    algorithm = ALGORITHMS[name]
    (learner,) = population([Learning(algorithm)] * 4, replicas=1).learners.values()
    named, by_list = (
        make_learner(
            changed(algorithm, update=update), GAME.spaces, agents=FOUR, replicas=1, seed=3, engine="eager"
        )
        for update in (UPDATES[name], "list")
    )
    for each in (learner, named, by_list):
        train(CommonsEnv(GAME, 1, seed=3), {FOUR: each}, Schedule(episodes=5))
    for lane in range(4):
        state, state_by_name, reference = (
            each.lane_networks.network_state(lane) for each in (learner, named, by_list)
        )
        for key, value in reference.items():
            assert torch.equal(state[key], state_by_name[key]), "this is the way that is found"
            torch.testing.assert_close(state[key], value, rtol=1e-3, atol=1e-5)


def test_unlike_agents_sit_side_by_side_in_one_training_and_like_ones_are_lanes():
    dqn, ppo = Learning(ALGORITHMS["DQN"]), Learning(ALGORITHMS["PPO"])
    mixed = population([dqn, ppo, dqn, Scripted("greedy")])
    assert {agents: type(learner.memory) for agents, learner in mixed.learners.items()} == {
        (0, 2): Replay,
        (1,): Rollouts,
    }
    assert list(mixed.others) == [(3,)]
    before = weights(mixed)
    training, returns = trained(mixed)
    assert training.steps == 72
    assert len(returns[0]) == len(returns[1]) == 6
    for key, value in weights(mixed).items():
        assert not torch.equal(value, before[key])


def of_gamma(gamma):
    return Learning(DQN(settings=replace(REPLAY, gamma=gamma)))


@pytest.mark.parametrize(
    ("members", "lanes"),
    [
        ([of_gamma(0.9) for _ in range(4)], [FOUR]),
        ([of_gamma(gamma) for gamma in (0.9, 0.9, 0.5, 0.5)], [(0, 1), (2, 3)]),
        ([of_gamma(0.9), replace(of_gamma(0.9), reward="team"), *[Scripted()] * 2], [(0,), (1,)]),
    ],
)
def test_equal_learners_are_lanes_and_those_of_another_value_or_reward_are_not(members, lanes):
    assert list(population(members).learners) == lanes


@pytest.mark.integration
def test_agents_that_follow_a_script_are_not_called_trained(tmp_path, capsys):
    ran(tmp_path, [Scripted("greedy")] * 4)
    assert "trained" not in capsys.readouterr().out


@pytest.mark.integration
def test_a_mixed_run_is_kept_evaluated_and_built_again_from_its_directory(tmp_path, capsys):
    members = [Learning(ALGORITHMS["DQN"]), Learning(ALGORITHMS["PPO"]), Scripted("greedy"), Scripted()]
    run, _ = ran(tmp_path, members)
    told = capsys.readouterr().out
    assert "agents act at random in 5%" in " ".join(told.split())
    assert " 0.05 ┃" in told
    loaded = cprl.load(run)
    assert list(loaded.experiment.agents) == members
    same = population(members)
    trained(same, episodes=4)
    seen = torch.randint(256, (5, *GAME.observation_shape), dtype=torch.uint8)
    for lane, network in same.networks().items():
        assert torch.equal(loaded.networks[lane](seen), network(seen))
    env = loaded.env(2)
    actions = loaded.policy(1, worlds=2)(env.reset())["agents", "action"]
    assert actions.shape == (2, 4)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    """A run of three agents by DQN and one by PPO, and its networks."""
    members = [Learning(ALGORITHMS["DQN"])] * 3 + [Learning(ALGORITHMS["PPO"])]
    return ran(tmp_path_factory.mktemp("earlier"), members)


@pytest.fixture
def windows():
    """What all agents see at first in two worlds."""
    return CommonsEnv(GAME, 2, seed=9).reset()["agents", "observation"]


def first_of(spec):
    """The actor of an agent beside three that play by chance; it does not explore."""
    actor = population([spec, *[Scripted()] * 3]).others[0,]
    actor.epsilon = 0.0
    return actor


@pytest.mark.integration
def test_a_frozen_agent_plays_what_it_learned_and_changes_no_more(earlier, windows, tmp_path, monkeypatch):
    run, networks = earlier
    monkeypatch.chdir(run.parent)
    seen, network = windows[:, :1], networks["replica_1/agent_2"]
    assert torch.equal(first_of(Frozen(run, 2, replica=1)).choose(seen), network(seen).argmax(-1))
    frozen = population([Frozen(run, 2, replica=1), *[Learning(ALGORITHMS["DQN"])] * 3])
    assert list(frozen.others) == [(0,)]
    before = frozen.others[0,].values(seen).clone()
    trained(frozen)
    assert torch.equal(frozen.others[0,].values(seen), before)
    assert sorted({name.split("/")[1] for name in frozen.networks()}) == ["agent_1", "agent_2", "agent_3"]
    again, _ = ran(tmp_path, [Frozen("run", 2), *[Scripted()] * 3], name="again")
    assert cprl.load(again).specs[0] == Frozen("run", 2)
    assert str(run.parent) not in (again / "recipe.json").read_text().split('"command"')[0]
    monkeypatch.chdir(run.parent.parent)
    moved = cprl.load(again)
    assert moved.specs[0] == Frozen(f"{run.parent.name}/run", 2)
    assert torch.equal(moved.agent(0).network(seen), networks["replica_0/agent_2"](seen))


@pytest.mark.integration
def test_frozen_agents_of_one_run_act_as_lanes_of_one_actor_and_as_alone(earlier, windows):
    run, _ = earlier
    specs = [
        Frozen(run, 2, replica=1),
        Frozen(run, 0, replica=None),
        Frozen(run, 3, replica=None),
        Frozen(run, 1, replica=(1, 0)),
    ]
    together = population(specs).others
    assert list(together) == [(0, 1, 3), (2,)], "agents of one kind"
    chosen = torch.stack([together[0, 1, 3].choose(windows[:, [0, 1, 3]]) for _ in range(20)])
    for place, agent in enumerate((0, 1, 3)):
        members = [Scripted()] * 4
        members[agent] = specs[agent]
        alone = population(members).others[agent,]
        for turn in chosen:
            assert torch.equal(turn[:, place], alone.choose(windows[:, [agent]])[:, 0])


@pytest.mark.integration
def test_each_replica_can_have_a_frozen_agent_of_its_own(earlier, windows, tmp_path, monkeypatch):
    run, networks = earlier
    monkeypatch.chdir(run.parent)
    spec, seen = Frozen("run", 2, replica=[1, 0]), windows[:, :1]
    assert spec.replica == (1, 0)
    learned = [
        networks[f"replica_{replica}/agent_2"](window).argmax(-1)
        for replica, window in zip((1, 0), seen, strict=True)
    ]
    assert torch.equal(first_of(spec).choose(seen), torch.stack(learned))
    again, _ = ran(tmp_path, [spec, *[Scripted()] * 3], name="again")
    loaded = cprl.load(again)
    assert loaded.specs[0] == spec
    assert torch.equal(loaded.agent(0, replica=1).network(seen), networks["replica_0/agent_2"](seen))
    with pytest.raises(ValueError, match=r"agents\[0\].replica is \(1,\), of 1 numbers"):
        ran(tmp_path, [Frozen("run", 2, replica=(1,)), *[Scripted()] * 3], name="too_few")
    assert not (tmp_path / "too_few").exists()
    for wrong in ((), (0, -1)):
        with pytest.raises(ValueError, match="replica"):
            Frozen("run", 2, replica=wrong)


@pytest.mark.integration
def test_a_tabular_agent_is_a_member_like_any_other(tmp_path, capsys):
    algorithm = Tabular(settings=TabularSettings(epsilon_hold_steps=5, epsilon_decay_steps=40))
    members = [Learning(algorithm), Learning(ALGORITHMS["DQN"]), Learning(algorithm), Scripted("greedy")]
    run, _ = ran(tmp_path, members)
    loaded = cprl.load(run)
    assert loaded.specs[2].algorithm == algorithm
    agents = population(members)
    trained(agents, episodes=4)
    table = q_table(agents.learners[0, 2], 3)
    assert len(table["visits"]) > 10
    seen, network = torch.from_numpy(table["observation"]), loaded.networks["replica_1/agent_2"]
    assert torch.equal(network(seen.unsqueeze(0))[0], torch.from_numpy(table["values"]))
    assert not network(torch.full_like(seen, 7)).any(), "of what was never met"
    assert set(evaluate_run(run, Fresh(episodes=2))["replica"].to_pylist()) == {0, 1}

    chosen = first_of(Frozen(run, 2, replica=1)).choose(seen[:2].unsqueeze(1))
    assert chosen[:, 0].tolist() == table["values"][:2].argmax(1).tolist()

    population(members, game=replace(GAME, observation=Observation(scoreboard=True)))


@pytest.mark.parametrize("reward_kind", ["individual", "team"])
def test_a_tabular_agent_is_paid_for_itself_or_for_the_group(reward_kind):
    class Witness:
        """What was paid last for an action in a state, by replica."""

        def __init__(self):
            self.last = {}

        def on_step(self, batch):
            rewards = batch["next", "agents", "reward"][..., 0]
            paid_now = rewards.sum(1) if reward_kind == "team" else rewards[:, 1]
            for replica, reward in enumerate(paid_now.tolist()):
                seen = batch["agents", "observation"][replica, 1].numpy().tobytes()
                self.last[replica, seen, int(batch["agents", "action"][replica, 1])] = reward

    algorithm = Tabular(settings=TabularSettings(gamma=0.0, learning_rate=1.0))
    agents = population(
        [Scripted("greedy"), Learning(algorithm, reward=reward_kind), *[Scripted("greedy")] * 2]
    )
    witness = Witness()
    train(
        CommonsEnv(GAME, 2), agents.learners, Schedule(episodes=10), others=agents.others, callbacks=[witness]
    )
    values = {}
    for replica in range(2):
        table = q_table(agents.learners[1,], replica)
        for seen, of_actions, visits in zip(
            table["observation"], table["values"], table["visits"], strict=True
        ):
            for action in visits.nonzero()[0].tolist():
                values[replica, seen.tobytes(), action] = of_actions[action]
    assert values == witness.last
    assert (max(values.values()) > 1) == (reward_kind == "team")


@dataclass(frozen=True, kw_only=True)
class PPOFromReplay(OffPolicy):
    settings: DQNSettings
    stochastic: ClassVar[bool] = True

    def make_network(self, spaces):
        return ALGORITHMS["PPO"].make_network(spaces)

    def make_loss(self, network):
        return ALGORITHMS["PPO"].make_loss(network)


def test_learners_that_do_not_fit_are_refused_before_training_and_the_refusal_says_what_fits():
    dqn, ppo = Learning(ALGORITHMS["DQN"]), ALGORITHMS["PPO"]
    with pytest.raises(ValueError, match="reward is 'group'"):
        Learning(ALGORITHMS["DQN"], reward="group")
    with pytest.raises(ValueError, match="3 agents are specified for a game of 4 agents"):
        population([dqn] * 3)
    with pytest.raises(ValueError, match="ClipPPOLoss is on-policy and cannot learn from a replay buffer"):
        population([Learning(PPOFromReplay(settings=REPLAY))] * 4)
    bare = changed(ppo, make_network=lambda spaces: acting_network(ppo.make_network(spaces)))
    with pytest.raises(ValueError, match="an agent has the networks "):
        make_learner(bare, GAME.spaces, agents=[0], replicas=1)
    with pytest.raises(ValueError, match="update_every is 7"):
        trained(population([Learning(ppo)] * 4), update_every=7)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("replica", "game", "message"),
    [
        (0, {"rules": replace(GAME.rules, window_rows=4)}, r"observations \(3, 3, 5\).*has \(3, 4, 5\)"),
        (0, {"observation": Observation(agents_apart=True)}, r"a form of observation .* this game has"),
        (9, {}, "keeps no network of replica_9/agent_0; kept are"),
    ],
)
def test_a_frozen_agent_that_does_not_fit_is_refused(earlier, replica, game, message):
    with pytest.raises(ValueError, match=message):
        population([Frozen(earlier[0], 0, replica=replica), *[Scripted()] * 3], game=replace(GAME, **game))
