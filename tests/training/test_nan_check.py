"""Numbers that are NaN or infinite are found and named, in every learner, before they are saved."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from c51 import C51
from checked_trainings import GAME, REPLAY, ROLLOUT
from dqn_parts import make_learner
from matrix_game import MatrixGame
from torchrl.envs import Transform, TransformedEnv

import cprl.training.training
from cprl import CommonsEnv, Custom, Experiment, algorithms, load, run
from cprl.algorithms import DQN, PPO, PR2, LOLASettings
from cprl.commands.recipe_command import parse_command
from cprl.envs.make_env import spaces_of
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.learners.lola import LOLANetworks
from cprl.learners.plain import PlainNetworks
from cprl.learners.tabular import TabularNetworks
from cprl.networks.finite import all_finite, finite_lanes
from cprl.population import Learning
from cprl.runs.checkpoints import Checkpointer, checkpoints_in
from cprl.training import Schedule, Training, train
from cprl.training.learning import LaneLosses
from cprl.training.nan_check import FiniteCheck, NotFinite, NotFiniteError, describe_findings

LOOK = LOLASettings(rollout_steps=6, hidden_cells=(8,))
STOCK, TEAM = {"engine": "torchrl"}, {"reward": "team"}
LEARNERS = {
    "DQN": (DQN(settings=REPLAY), {}),
    "DQN with soft updates": (DQN(settings=replace(REPLAY, tau=0.1)), {}),
    "C51": (C51(settings=REPLAY, atoms=5), {}),
    "SAC": (algorithms.SAC(settings=REPLAY), {}),
    "PR2": (PR2(settings=REPLAY), {}),
    "PR2 of TorchRL": (PR2(settings=REPLAY), STOCK),
    "PPO": (PPO(settings=ROLLOUT), {}),
    "DQN of TorchRL": (DQN(settings=REPLAY), STOCK),
    "PPO of TorchRL": (PPO(settings=ROLLOUT), STOCK),
    "Reinforce of TorchRL": (algorithms.Reinforce(settings=ROLLOUT), STOCK),
    "Tabular": (algorithms.Tabular(settings=algorithms.TabularSettings()), {}),
    **{name: (getattr(algorithms, name)(settings=REPLAY), TEAM) for name in ("VDN", "QMIX")},
    "IPPO": (algorithms.IPPO(settings=ROLLOUT), {}),
    "MADDPG": (algorithms.MADDPG(settings=REPLAY), {}),
    "MAPPO": (algorithms.MAPPO(settings=ROLLOUT), TEAM),
    "LOLA": (algorithms.LOLA(settings=LOOK), {}),
    "LOLA by DiCE": (algorithms.LOLA(settings=LOOK, estimator="dice"), {}),
}
REPLICAS, BROKEN = 3, (1, 0)
"""The replica and the agent that break."""


def learner_named(name, **changes):
    algorithm, settings = LEARNERS[name]
    settings = {"engine": "eager", "reward": "individual", "replicas": REPLICAS, **settings, **changes}
    return make_learner(algorithm, GAME.spaces, agents=(0, 1), seed=5, **settings)


def tensors_of(learner, replica, agent):
    """The trained weights of a lane, as tensors to write into."""
    if isinstance(learner.lane_networks, TabularNetworks):
        lane = replica * len(learner.agents) + agent
        tables = learner.lane_networks.tables
        return [torch.from_numpy(tables.values)[list(tables.rows[lane].values())[-1]]]
    of_replica = len(learner.lanes) // learner.replicas
    lane = replica * of_replica + (agent if of_replica > 1 else 0)
    if isinstance(learner.lane_networks, LOLANetworks):
        stacks = (learner.lane_networks.actors, learner.lane_networks.players)
        return [weights.data[replica] for stack in stacks for weights in stack[agent].parameters()]
    if isinstance(learner.lane_networks, PlainNetworks):
        return [weights.data for weights in learner.lane_networks.losses[lane].parameters()]
    return [weights[lane] for weights in learner.lane_networks.params.values()]


class Breaks:
    """Makes the weights of a lane NaN at a step, and notes returns and actions."""

    def __init__(self, step=-1):
        self.step, self.returns, self.actions = step, {}, []

    def on_start(self, training):
        (self.learner,) = training.learners.values()

    def on_step(self, batch):
        self.actions.append(batch["agents", "action"].clone())
        if len(self.actions) == self.step:
            for tensor in tensors_of(self.learner, *BROKEN):
                tensor.fill_(torch.nan)

    def on_episode(self, episode, learning):
        self.returns.setdefault(episode.world, []).append(episode.return_.tolist())


def play(learner, *, breaks=-1, episodes=3, on_nan="stop"):
    """The training of a learner that breaks at a step, and what was seen of it."""
    seen = Breaks(breaks)
    env = CommonsEnv(GAME, learner.replicas, seed=2)
    schedule = Schedule(episodes=episodes, on_nan=on_nan)
    training = train(env, {learner.agents: learner}, schedule, callbacks=[seen])
    return training, seen


@pytest.mark.integration
@pytest.mark.parametrize("name", LEARNERS)
def test_a_lane_that_breaks_stops_the_training_and_is_named(name):
    learner = learner_named(name)
    of_team = name in ("VDN", "QMIX", "IPPO", "MAPPO", "MADDPG") or name.startswith("LOLA")
    agents = r"agents 0, 1" if of_team else "agent 0"
    with pytest.raises(NotFiniteError, match=rf"^at step \d+ .*the weights of {agents} in replica 1 are not"):
        play(learner, breaks=14)
    assert learner.finite()[[0, 2]].all()
    assert not learner.finite()[BROKEN]


FEW = ("PPO", "Tabular", "VDN")
CONTINUING = [
    *(pytest.param(name, {}, marks=() if name in FEW else pytest.mark.slow) for name in LEARNERS),
    *(
        pytest.param(name, {"engine": "compiled"}, marks=pytest.mark.slow)
        for name in ("DQN", "PPO", "VDN", "MAPPO")
    ),
]


@pytest.mark.integration
@pytest.mark.parametrize(("name", "engine"), CONTINUING)
def test_with_continue_a_broken_lane_is_named_once_and_other_replicas_learn_as_without_it(name, engine):
    whole, sound = learner_named(name, **engine), learner_named(name, **engine)
    with pytest.warns(RuntimeWarning, match=r"replica 1 .*not finite.*; the others train on") as warned:
        training, seen = play(whole, breaks=14, episodes=4, on_nan="continue")
    assert sum("not finite" in str(warning.message) for warning in warned) == 1
    _, wanted = play(sound, episodes=4)
    for replica in (0, 2):
        assert seen.returns[replica] == wanted.returns[replica]
        for agent in (0, 1):
            lane = f"replica_{replica}/agent_{agent}"
            ends = (each.networks()[lane].state_dict() for each in (whole, sound))
            torch.testing.assert_close(*ends, rtol=0, atol=0)
    assert {finding.replica for finding in training.finite.reported} == {1}
    assert all(0 <= int(action) < GAME.spaces.actions for turn in seen.actions for action in turn.flatten())


@pytest.fixture
def looks_every_step(monkeypatch):
    monkeypatch.setattr(cprl.training.training, "EVERY_TURNS", 1)


def test_a_single_infinite_loss_is_named_with_its_step_and_whether_the_weights_are_sound():
    learner, losses, returns = learner_named("DQN"), LaneLosses(3, (0, 1)), np.zeros((3, 2))

    def look(check, total, step, **changes):
        losses.total[:] = total
        check.check({(0, 1): losses}, returns, step, **changes)

    check = FiniteCheck({(0, 1): learner}, GAME.spaces)
    look(check, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], 1)
    with pytest.raises(
        NotFiniteError, match=r"^at step 1,234 the loss of agent 1 in replica 2 is not finite;"
    ):
        look(check, [[1.0, 2.0], [3.0, 4.0], [5.0, np.inf]], 1234)
    tensors_of(learner, 2, 1)[0].fill_(torch.inf)
    check = FiniteCheck({(0, 1): learner}, GAME.spaces, on_nan="continue")
    broken = [[np.nan, 2.0], [3.0, 4.0], [5.0, np.nan]]
    with pytest.warns(RuntimeWarning) as warned:
        look(check, broken, 1234)
    with warnings.catch_warnings():  # named once
        warnings.simplefilter("error")
        look(check, broken, 1235, weights=True)
    (message,) = [str(warning.message) for warning in warned]
    assert message == (
        "at step 1,234 the loss of agent 0 in replica 0, the loss of agent 1 in replica 2, and the weights "
        "of agent 1 in replica 2 are not finite (weights were last checked at step 0); the others train on"
    )
    assert check.reported[-1] == NotFinite("weights", 2, 1, 1234)


def test_what_is_not_finite_is_not_named_without_end():
    many = [NotFinite("loss", replica, agent, 7) for replica in range(20) for agent in range(2)]
    assert describe_findings(many).endswith("the loss of agents 0, 1 in replica 7, and 12 more are")


def test_large_numbers_are_finite():
    large = torch.full((2, 3), 3e38)
    assert finite_lanes([large, torch.zeros(2), torch.zeros(2, dtype=torch.int64)]).all()
    assert all_finite([large, torch.zeros(0), torch.zeros(3, dtype=torch.uint8)])
    assert not all_finite([torch.ones(3), torch.tensor(torch.nan)])
    opposite = torch.tensor([[torch.inf, -torch.inf], [0.0, 1.0]])
    assert finite_lanes([opposite]).tolist() == [False, True]


class Poison(Transform):
    """Makes an entry NaN, of one world and agent, from a step on."""

    def __init__(self, name, *, world, agent, step, reset=False):
        super().__init__()
        self.name, self.place, self.step, self.steps, self.at_reset = name, (world, agent), step, 0, reset

    def _step(self, tensordict, next_tensordict):
        self.steps += 1
        if self.steps >= self.step:
            next_tensordict["agents", self.name][self.place] = torch.nan
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        if self.at_reset:
            tensordict_reset["agents", self.name][self.place] = torch.nan
        return tensordict_reset


def poisoned(entry, *, step, learning_starts=4, steps=5, **changes):
    env = TransformedEnv(MatrixGame(3, steps=steps), Poison(entry, world=2, agent=1, step=step, **changes))
    algorithm = DQN(settings=replace(REPLAY, learning_starts=learning_starts))
    learner = make_learner(algorithm, spaces_of(env), agents=(0, 1), replicas=3, engine="eager")
    return Training(env, {(0, 1): learner}, Schedule(episodes=3))


def step(training, steps):
    for _ in range(steps):
        training.step()


@pytest.mark.parametrize(
    ("entry", "poison", "at_step"),
    [
        ("reward", {"step": 4}, 4),
        ("observation", {"step": 3}, 3),
        ("observation", {"step": 99, "reset": True}, 1),
    ],
)
def test_rewards_and_observations_that_are_not_finite_are_blamed_on_the_environment(
    entry, poison, at_step, looks_every_step
):
    whose = r"of agent 1 in replica 2(,| is).* not finite.*it comes from the environment.* transforms"
    with pytest.raises(NotFiniteError, match=rf"^at step {at_step} .*the {entry} {whose}"):
        step(poisoned(entry, **poison), 12)


@pytest.mark.parametrize("entry", ["reward", "observation"])
@pytest.mark.parametrize(("steps", "found_at"), [(20, 16), (5, 5)])
def test_what_a_game_gives_is_looked_at_every_sixteen_steps_and_when_episodes_end(entry, steps, found_at):
    training = poisoned(entry, step=2, steps=steps, learning_starts=90)
    step(training, found_at - 1)
    with pytest.raises(NotFiniteError, match=rf"^at step {found_at} the {entry} of agent 1 in replica 2"):
        training.step()


def a_training(**changes):
    learner = learner_named("DQN")
    schedule = Schedule(episodes=9, **changes)
    return Training(CommonsEnv(GAME, REPLICAS, seed=2), {(0, 1): learner}, schedule)


def test_no_checkpoint_holds_what_is_not_finite_and_the_last_one_is_kept(tmp_path):
    training, again = a_training(), a_training()
    with Checkpointer(tmp_path) as checkpointer:
        step(training, 9)
        checkpointer.save(training)
        before = checkpoints_in(tmp_path / "checkpoints")
        tensors_of(training.learners[0, 1], *BROKEN)[1].fill_(-torch.inf)
        match = r"at step 9 the weights of agent 0 in replica 1 are .*; what was saved at step 9 is finite$"
        with pytest.raises(NotFiniteError, match=match):
            checkpointer.save(training)
        assert checkpoints_in(tmp_path / "checkpoints") == before
        checkpointer.restore(again)
        assert again.steps == 9
        assert again.learners[0, 1].finite().all()


def test_with_continue_the_last_sound_checkpoint_is_kept_beside_the_others(tmp_path):
    training, again = a_training(on_nan="continue"), a_training(on_nan="continue")
    folder = tmp_path / "checkpoints"
    with Checkpointer(tmp_path) as checkpointer:

        def step_and_save(training, steps):
            for _ in range(steps):
                training.step()
                checkpointer.save(training)

        step_and_save(training, 3)
        sound = checkpoints_in(folder)[-1]
        tensors_of(training.learners[0, 1], *BROKEN)[0].fill_(torch.nan)
        with pytest.warns(RuntimeWarning, match="weights of agent 0 in replica 1"):
            checkpointer.save(training)
        step_and_save(training, 4)
        beside = folder / f"sound-{sound.name}"
        assert beside.exists()
        assert sound not in checkpoints_in(folder)
        checkpointer.restore(again)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            step_and_save(again, 1)
        assert not again.is_finite
        beside.rename(sound)
        for path in checkpoints_in(folder):
            if path != sound:
                path.unlink()
        checkpointer.restore(again)
        assert (again.steps, again.is_finite) == (3, True)


def test_a_learner_of_somebodys_own_that_refuses_nan_is_explained():
    class Refuses(Learner):
        def update(self):
            losses = super().update()
            if not self.finite().all():
                raise RuntimeError("probability tensor contains either `inf`, `nan` or element < 0")
            return losses

    lanes = Lanes(GAME.spaces, agents=(0, 1), replicas=REPLICAS)
    learner = Refuses(DQN(settings=REPLAY), lanes, "eager")
    with pytest.raises(NotFiniteError, match="at step 6 the weights of agent 0 in replica 1 are") as caught:
        play(learner, breaks=5)
    assert "probability tensor" in str(caught.value.__context__)


def experiment(**changes):
    small = {"replicas": 2, "episodes": 2, "evaluation_episodes": 1, "engine": "eager", **changes}
    return Experiment(name="breaks", game=GAME, agents=(Learning(DQN(settings=REPLAY)),) * 2, **small)


def test_on_nan_is_stop_or_continue_and_the_command_line_says_it_too():
    with pytest.raises(ValueError, match="on_nan is 'no'"):
        experiment(on_nan="no")
    assert parse_command(experiment, ["recipe.py"])[0].on_nan == "stop"
    assert parse_command(experiment, ["recipe.py", "--on-nan", "continue"])[0].on_nan == "continue"


@pytest.mark.integration
def test_a_run_that_stopped_is_resumed_with_continue_and_its_summary_names_who_is_broken(
    tmp_path, capsys, looks_every_step
):
    stopping = experiment(callbacks=(Custom("test_nan_check:Breaks", arguments={"step": 5}),))
    with pytest.raises(NotFiniteError, match=r"at step 6 .*agent 0 in replica 1") as stopped:
        run(stopping, tmp_path / "run", watch="off")
    assert any("To resume:" in note for note in stopped.value.__notes__)
    continuing = replace(stopping, on_nan="continue")
    with pytest.warns(RuntimeWarning, match=r"at step 6 .*agent 0 in replica 1.*; the others train on"):
        directory = run(continuing, tmp_path / "run", watch="off", resume=True)
    printed = capsys.readouterr().out
    assert (
        "From step 6 on the loss of agent 0 in replica 1, and the weights of agent 0 in replica 1" in printed
    )
    findings = json.loads((directory / "report.json").read_text())["not_finite"]
    assert findings[0] == {"what": "loss", "replica": 1, "agent": 0, "step": 6}
    cprl.trust("test_nan_check:Breaks")
    loaded = load(directory)
    assert loaded.experiment == continuing
    assert loaded.agent(0, replica=0).network is not None
    with pytest.raises(ValueError, match="weights of replica_1/agent_0 are NaN or infinite"):
        loaded.agent(0, replica=1)
