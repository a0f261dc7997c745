"""Learners of one process share compiled code, and each learns exactly as it would alone in a fresh one."""

import hashlib
import subprocess
import sys
import warnings
from dataclasses import replace

import pytest
import torch
from dqn_parts import make_learner
from torch import nn

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.system import compiling
from cprl.system.process import prepare_process
from cprl.training import Training

AGENTS = (0, 1)
PATCH = Game(map=maps.parse(".A>A.\n..<A."), rules=Rules(regrow_prob=(0.1,), episode_steps=20))
SMALL = DQNSettings(hidden_cells=(8, 8), buffer_size=200, learning_rate=1e-3, gamma=0.9, learning_starts=4)
CASES = {
    "plain": DQN(settings=SMALL),
    "another gamma": DQN(settings=replace(SMALL, gamma=0.3)),
    "another learning rate": DQN(settings=replace(SMALL, learning_rate=1e-2)),
    "another exploration": DQN(settings=replace(SMALL, epsilon_hold_steps=0, epsilon_decay_steps=10)),
    "another target period": DQN(settings=replace(SMALL, target_every_episodes=1)),
    "another buffer": DQN(settings=replace(SMALL, buffer_size=100)),
    "double": DQN(settings=SMALL, double=True),
    "wider": DQN(settings=replace(SMALL, hidden_cells=(16, 8))),
    "another epsilon of Adam": DQN(settings=replace(SMALL, adam_eps=1e-2)),
    "another share of the loss": DQN(settings=replace(SMALL, mean_over_all_outputs=True)),
    "soft targets": DQN(settings=replace(SMALL, tau=0.1)),
    "softer targets": DQN(settings=replace(SMALL, tau=0.01)),
    "another optimiser": DQN(settings=replace(SMALL, optimizer="rmsprop")),
    "another optimiser and rate": DQN(settings=replace(SMALL, optimizer="rmsprop", learning_rate=1e-2)),
    "that of Keras": DQN(settings=replace(SMALL, optimizer="keras_rmsprop")),
    "larger batches": DQN(settings=replace(SMALL, batch_size=16)),
}
SHARING = ("plain", "another gamma", "another learning rate", "another exploration", "another target period")
ALONE = ("plain", "another gamma", "another learning rate", "double", "wider")


def trained(case, *, seed=0, steps=60):
    """A learner after a short training."""
    prepare_process(seed)
    learner = make_learner(CASES[case], PATCH.spaces, agents=AGENTS, replicas=2, seed=seed)
    env = CommonsEnv(PATCH, 2, seed=seed)
    training = Training(env, {AGENTS: learner}, episodes=10**6)
    with warnings.catch_warnings():
        for kind in (DeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", kind)
        while training.steps < steps:
            training.step()
    assert learner.engine._compiled.enabled
    return learner


def digest(learner):
    """Of all weights, targets, moments and stored transitions, to the bit."""
    engine = learner.engine
    tensors = [
        *engine.params.values(),
        *engine.targets.values(),
        *engine._mean.values(),
        *engine._square.values(),
    ]
    tensors += learner.buffer.fields.values()
    whole = hashlib.sha256()
    for tensor in tensors:
        whole.update(tensor.detach().contiguous().numpy().tobytes())
    return whole.hexdigest()


def alone(case, seed=0):
    """The same in a fresh process."""
    command = [sys.executable, __file__, case, str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()[-1]


@pytest.fixture
def compilations(monkeypatch):
    """Where each call of torch.compile is counted."""
    made = []
    compile_by_torch = torch.compile

    def counted(function, **how):
        made.append(function.__name__)
        return compile_by_torch(function, **how)

    monkeypatch.setattr(compiling.torch, "compile", counted)
    monkeypatch.setattr(compiling, "_shared", {})
    return made


@pytest.mark.integration
def test_learners_that_differ_in_numbers_alone_share_code_and_differ_in_what_they_learn(compilations):
    learned = {case: digest(trained(case)) for case in SHARING}
    assert sorted(compilations) == ["_explored_of_its_own", "_step_of_its_own"]
    learned["another seed"] = digest(trained("plain", seed=5))
    assert len(compilations) == 2
    assert len(set(learned.values())) == len(learned)
    assert digest(trained("plain")) == learned["plain"], "what others learned in between changes nothing"


@pytest.mark.integration
@pytest.mark.parametrize(
    "cases",
    [
        ("plain", "another epsilon of Adam"),
        pytest.param(("plain", "another share of the loss"), marks=pytest.mark.slow),
        pytest.param(("plain", "double"), marks=pytest.mark.slow),
        pytest.param(("plain", "wider"), marks=pytest.mark.slow),
        pytest.param(("plain", "larger batches"), marks=pytest.mark.slow),
        pytest.param(("plain", "another buffer"), marks=pytest.mark.slow),
        pytest.param(("soft targets", "softer targets"), marks=pytest.mark.slow),
        pytest.param(("another optimiser", "another optimiser and rate"), marks=pytest.mark.slow),
        pytest.param(("another optimiser", "that of Keras"), marks=pytest.mark.slow),
    ],
    ids=lambda cases: cases[1],
)
def test_a_learner_that_differs_in_what_is_a_constant_of_the_code_gets_its_own(cases, compilations):
    first, second = (digest(trained(case)) for case in cases)
    assert compilations.count("_step_of_its_own") == 2
    assert first != second
    for case, learned in zip(cases, (first, second), strict=True):
        assert digest(trained(case)) == learned
    assert compilations.count("_step_of_its_own") == 2, "each has found its own again"


@pytest.mark.slow
def test_after_others_in_one_process_everyone_learns_as_alone_in_a_fresh_one():
    together = {case: digest(trained(case)) for case in (*CASES, *reversed(CASES))}
    for case in ALONE:
        assert together[case] == alone(case), case
    assert digest(trained("plain", seed=3)) == alone("plain", 3)


@pytest.mark.integration
def test_a_learner_that_shares_code_trains_its_own_weights_alone(compilations):
    first = trained("plain")
    before = digest(first)
    second = trained("another gamma")
    assert len(compilations) == 2
    assert digest(first) == before
    own = {tensor.data_ptr() for tensor in first.engine.params.values()}
    assert own.isdisjoint(tensor.data_ptr() for tensor in second.engine.params.values())


def scaled(owner, values):
    return owner.layer(values) * owner.factor


class Owner(nn.Module):
    """What a user's network may hold: a number, a tensor that is no buffer, a function."""

    def __init__(self, factor=2.0, *, offset=1.0, then=torch.relu):
        super().__init__()
        self.factor, self.then = factor, then
        self.offset = torch.tensor(offset)
        self.weight = nn.Parameter(torch.ones(3), requires_grad=False)

    def layer(self, values):
        return self.then(values * self.weight + self.offset)


def shared_call(owner):
    return compiling.Compiled(scaled, what="tests run")((), owner, torch.ones(3)).tolist()


@pytest.mark.integration
def test_tensors_of_an_owner_are_its_own_and_everything_else_is_a_constant(compilations):
    assert shared_call(Owner()) == [4.0] * 3
    assert shared_call(Owner(offset=5.0)) == [12.0] * 3
    assert len(compilations) == 1
    assert shared_call(Owner(3.0)) == [6.0] * 3
    assert shared_call(Owner(then=torch.neg)) == [-4.0] * 3
    assert len(compilations) == 3
    hooked = Owner()
    hooked.layer = lambda values: values
    assert shared_call(hooked) == [2.0] * 3
    assert len(compilations) == 4
    assert shared_call(Owner(3.0, offset=0.0)) == [3.0] * 3
    assert len(compilations) == 4


@pytest.mark.integration
def test_closures_are_constants_too(compilations):
    def times(number):
        return lambda values: values * number

    assert shared_call(Owner(then=times(2.0))) == [8.0] * 3
    assert shared_call(Owner(then=times(3.0))) == [12.0] * 3
    assert shared_call(Owner(then=times(2.0))) == [8.0] * 3
    assert len(compilations) == 2


@pytest.mark.integration
def test_shared_code_that_gives_other_numbers_is_given_up(compilations, monkeypatch):
    """As a second line of defence: with guards that let everything through."""
    monkeypatch.setattr(compiling, "fits", lambda *_: True)
    assert shared_call(Owner()) == [4.0] * 3
    assert shared_call(Owner(3.0)) == [6.0] * 3
    assert len(compilations) == 2


@pytest.mark.integration
def test_only_so_many_forms_are_kept(compilations, monkeypatch):
    monkeypatch.setattr(compiling, "MOST_SHARED", 2)
    for factor in (1.0, 2.0, 3.0):
        shared_call(Owner(factor))
    assert [len(kept) for kept in compiling._shared.values()] == [2]
    shared_call(Owner(3.0))
    assert len(compilations) == 3
    shared_call(Owner(1.0))
    assert len(compilations) == 4


if __name__ == "__main__":
    print(digest(trained(sys.argv[1], seed=int(sys.argv[2]))))
