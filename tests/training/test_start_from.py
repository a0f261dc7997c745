"""A training can start from the weights that an earlier run kept, with every kind of learner."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from checked_trainings import GAME, REPLAY, ROLLOUT
from dqn_parts import weights_at
from same_runs import assert_same_training
from stored_runs import command

import cprl
from cprl import CommonsEnv, Experiment
from cprl.algorithms import DQN, IPPO, MADDPG, MAPPO, PPO, QMIX, SAC, VDN, Tabular, TabularSettings
from cprl.commands.recipe_command import parse_command
from cprl.measuring.playing import evaluate
from cprl.objectives.rewards import Exchange
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.runs.checkpoints import checkpoints_in
from cprl.runs.weights import load_weights, save_weights
from cprl.training import Schedule, train
from cprl.training.agents import Population

FOUR = replace(GAME, map=cprl.maps.parse(".A>.A.A\nA<A.v.A\n..<.A.A"))
ALONE = (
    Learning(DQN(settings=REPLAY)),
    Learning(PPO(settings=ROLLOUT)),
    Learning(Tabular(settings=TabularSettings())),
    Learning(SAC(settings=REPLAY)),
)
TEAMS = (Team(VDN(settings=REPLAY), agents=(0, 2)), Team(MAPPO(settings=ROLLOUT), agents=(1, 3)))


def experiment(agents, **changes):
    how = {"replicas": 2, "episodes": 2, "evaluation_episodes": 1, "engine": "eager", "seed": 4, **changes}
    return Experiment(name="start", game=FOUR, agents=agents, **how)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Two runs, of agents alone and of teams, and where they are from here."""
    folder = tmp_path_factory.mktemp("stored")
    for name, agents in (("alone", ALONE), ("teams", TEAMS)):
        cprl.run(experiment(agents), folder / name, watch="off")
    cprl.run(
        experiment((Frozen(os.path.relpath(folder / "alone"), 0), *[Scripted()] * 3)),
        folder / "frozen",
        watch="off",
    )
    return os.path.relpath(folder)


def population(agents, **how):
    return Population(CommonsEnv(FOUR, 2, seed=4), agents, **{"engine": "eager", "seed": 8, **how})


def same(network, state):
    return all(torch.equal(own, state[name]) for name, own in network.state_dict().items())


TABLE = 2
ENGINES = [(engine, agent) for engine in ("eager", "torchrl") for agent in range(4)]
ENGINES.remove(("torchrl", TABLE))
COMPILED = [pytest.param("compiled", agent, marks=pytest.mark.slow) for agent in range(4)]


@pytest.mark.integration
@pytest.mark.parametrize(("engine", "agent"), [*ENGINES, *COMPILED])
def test_agents_start_with_the_weights_of_a_stored_one(stored, engine, agent):
    kept = load_weights(Path(f"{stored}/alone/checkpoints/final.pt"))
    spec = replace(ALONE[agent], start_from=Frozen(f"{stored}/alone", agent, replica=1))
    begun = population([spec, spec, Scripted(), Scripted()], engine=engine)
    assert len(begun.networks()) == 4
    assert all(same(own, kept[f"replica_1/agent_{agent}"]) for own in begun.networks().values())
    own = replace(spec, start_from=Frozen(f"{stored}/alone", agent, replica=None))
    begun = population([own, Scripted(), Scripted(), Scripted()], engine=engine)
    for replica in (0, 1):
        name = f"replica_{replica}/agent_{agent}"
        assert same(begun.networks()[f"replica_{replica}/agent_0"], kept[name])


@pytest.mark.parametrize(
    ("algorithm", "stored_agents"),
    [
        *((kind(settings=REPLAY), {1: 0, 3: 2}) for kind in (VDN, QMIX)),
        *((kind(settings=ROLLOUT), {0: 1, 1: 3}) for kind in (MAPPO, IPPO)),
        (MADDPG(settings=REPLAY), {0: 1, 1: 3}),
    ],
)
def test_members_of_a_team_start_with_the_weights_of_the_members_of_a_stored_one(
    stored, algorithm, stored_agents
):
    kept = load_weights(Path(f"{stored}/teams/checkpoints/final.pt"))
    for replicas in ((None, (0, 1)), (1, (1, 1))):
        start = Frozen(f"{stored}/teams", max(stored_agents.values()), replica=replicas[0])
        begun = population([Team(algorithm, tuple(stored_agents), start_from=start), Scripted(), Scripted()])
        for replica, theirs in enumerate(replicas[1]):
            for agent, stored_agent in stored_agents.items():
                network = begun.networks()[f"replica_{replica}/agent_{agent}"]
                assert same(network, kept[f"replica_{theirs}/agent_{stored_agent}"])


def test_without_updates_it_plays_what_was_stored(stored):
    frozen = Frozen(f"{stored}/alone", 0)
    played = []
    for spec in (replace(ALONE[0], start_from=frozen), frozen):
        policy = population([spec, *[Scripted("sustainable")] * 3]).policy(1)
        played.append([own.return_.tolist() for own in evaluate(CommonsEnv(FOUR, 2, seed=1), policy)])
    assert played[0] == played[1]


def test_who_starts_from_stored_weights_wants_what_it_is_told(stored):
    spec = replace(ALONE[0], reward=Exchange(0.5), start_from=Frozen(f"{stored}/alone", 0, replica=None))
    agents = population([spec, *[Scripted()] * 3])
    (learner,) = agents.learners.values()
    assert learner.rewards.reward == Exchange(0.5)
    train(CommonsEnv(FOUR, 2, seed=1), agents.learners, Schedule(episodes=1), others=agents.others)


def test_where_to_start_is_a_flag():
    begun = experiment((replace(ALONE[0], start_from=Frozen("a", 0)), *[Scripted()] * 3))
    words = ["recipe.py", "--agents.0.start-from.run", "b", "--agents.0.start-from.agent", "2"]
    assert parse_command(lambda: begun, words)[0].agents[0].start_from == Frozen("b", 2)


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
@pytest.mark.parametrize("own_target_weights", [False, True])
def test_targets_start_with_the_same_weights_and_the_optimiser_and_exploration_anew(
    stored, engine, own_target_weights
):
    settings = replace(REPLAY, own_target_weights=own_target_weights)
    spec = Learning(DQN(settings=settings), start_from=Frozen(f"{stored}/alone", 0))
    (learner,) = population([spec, *[Scripted()] * 3], engine=engine).learners.values()
    weights = weights_at(learner.lane_networks, 0)
    targets = [own for name, own in weights.items() if name.startswith("target_")]
    trained = [own for name, own in weights.items() if not name.startswith("target_")]
    trained = [own for own in trained if own.is_floating_point() and own.ndim]
    assert targets
    for target in targets:
        assert any(own.shape == target.shape and torch.equal(own, target) for own in trained)
    assert learner.steps == 0
    assert learner.actor.epsilon == settings.epsilon(0) == 1.0


@pytest.mark.integration
def test_a_training_that_starts_from_another_is_run_stopped_and_resumed_without_it(
    stored, tmp_path, monkeypatch, stopped, capsys
):
    shutil.copytree(f"{stored}/alone", tmp_path / "alone")
    monkeypatch.chdir(tmp_path)
    spec = replace(ALONE[0], start_from=Frozen("alone", 0))
    begun = experiment((spec, Scripted(), Scripted(), Scripted()), episodes=4)
    whole = cprl.run(begun, "runs/whole", watch="off")
    assert cprl.load(whole).experiment == begun
    recipe = cprl.runs.recipe.read_recipe(whole)
    assert recipe["experiment"]["agents"][0]["start_from"]["run"] == "../../alone"
    stopping = replace(begun, callbacks=(cprl.Custom("own_parts:Stopping"),))
    stopped(20, stopping, "runs/stopped")
    assert checkpoints_in(tmp_path / "runs/stopped/checkpoints")
    shutil.rmtree(tmp_path / "alone")
    words = ["run", "runs/stopped", "--resume", "--watch", "off", "--allow", "own_parts:Stopping"]
    command(monkeypatch, capsys, *words)
    assert_same_training(tmp_path / "runs/stopped", tmp_path / "runs/whole")


@pytest.mark.integration
def test_what_cannot_be_started_from_is_refused_by_name(stored, tmp_path):
    dqn, ppo, run, teams = DQN(settings=REPLAY), ALONE[1].algorithm, f"{stored}/alone", f"{stored}/teams"
    wider = DQN(settings=replace(REPLAY, hidden_cells=(9,)))
    relu = DQN(settings=replace(REPLAY, relu_on_outputs=True))
    for algorithm, start, message in (
        (dqn, Frozen(run, 4), r"agent is 4; .*alone has the agents 0 to 3"),
        (dqn, Frozen(run, 0, replica=2), "keeps no network of replica_2/agent_0"),
        (dqn, Frozen(f"{stored}/frozen", 1), "agent_1 of .*frozen is scripted"),
        (dqn, Frozen(f"{stored}/nowhere", 0), "nowhere"),
        (dqn, Frozen(run, 1), "agent_1 of .*alone outputs the logits of a policy; DQN learns action values"),
        (ppo, Frozen(run, 0), "outputs action values; PPO learns the logits of a policy"),
        (wider, Frozen(run, 0), "agent_0 of .* has another network than DQN here: .*siz"),
        (relu, Frozen(run, 0), "with the same weights the outputs differ"),
    ):
        with pytest.raises(ValueError, match=message):
            population([Learning(algorithm, start_from=start), *[Scripted()] * 3])
    for agents, start, message in (
        ((0, 1), Frozen(run, 0), "agent 0 of .*alone is in no team; allowed for a te"),
        ((0, 1, 2), Frozen(teams, 0), "is in a team of 2; .*: a member of a team of 3"),
    ):
        team = Team(VDN(settings=REPLAY), agents, start_from=start)
        with pytest.raises(ValueError, match=message):
            population([team, *[Scripted()] * (4 - len(agents))])
    dqn = ALONE[0]
    spec = replace(dqn, start_from=Frozen(run, 0))
    taller = replace(FOUR, rules=replace(FOUR.rules, window_rows=4))
    with pytest.raises(ValueError, match=r"have observations .*; this game has"):
        Population(CommonsEnv(taller, 2), [spec, *[Scripted()] * 3], engine="eager")
    with pytest.raises(ValueError, match=r"experiment\.agents\[0\]\.start_from\.run is /x, an absolute path"):
        experiment((replace(dqn, start_from=Frozen("/x", 0)), *[Scripted()] * 3))
    broken = experiment((replace(dqn, start_from=Frozen(run, 7)), *[Scripted()] * 3))
    with pytest.raises(ValueError, match="agent is 7"):
        cprl.run(broken, tmp_path / "never", watch="off")
    assert not (tmp_path / "never").exists()


def test_weights_that_are_not_finite_are_no_start(stored, tmp_path):
    shutil.copytree(f"{stored}/alone", tmp_path / "alone")
    spec = replace(ALONE[0], start_from=Frozen(os.path.relpath(tmp_path / "alone"), 0))
    networks = population([spec, *[Scripted()] * 3]).networks()
    weights = list(networks["replica_0/agent_0"].parameters())
    assert all(own.isfinite().all() for own in weights), "as they are stored they are a start"
    for own in weights:
        own.data.fill_(torch.nan)
    save_weights(tmp_path / "alone", networks)
    with pytest.raises(ValueError, match="weights of replica_0/agent_0 are NaN or infinite; leave that rep"):
        population([spec, *[Scripted()] * 3])


def test_a_frozen_agent_can_be_that_of_its_own_replica(stored):
    own = population([Frozen(f"{stored}/alone", 0, replica=None), *[Scripted()] * 3])
    each = [population([Frozen(f"{stored}/alone", 0, replica), *[Scripted()] * 3]) for replica in (0, 1)]
    seen = torch.randint(256, (2, 1, *FOUR.spaces.observation_shape), dtype=torch.uint8)
    values = own.others[0,].values(seen)
    torch.testing.assert_close(values[0], each[0].others[0,].values(seen)[0])
    torch.testing.assert_close(values[1], each[1].others[0,].values(seen)[1])
    assert not torch.allclose(values[1], each[0].others[0,].values(seen)[1])
