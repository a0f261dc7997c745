"""Compiled: the same as the plain function, whatever form its arguments take; and learners of one process,
which share compiled code, while each learns exactly as it would alone in a fresh one."""

import hashlib
import subprocess
import sys
import warnings
from dataclasses import replace

import pytest
import torch
from dqn_parts import make_learner
from tensordict import TensorDict
from torch import nn

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.system import compiling
from cprl.system.compiling import Compiled, largest_difference
from cprl.system.process import prepare_process
from cprl.training import Schedule, Training


def scaled_in_place(owner, values, factor):
    values.mul_(factor)
    return values.sum() + owner.offset


class Holds:
    offset = 1.0


@pytest.mark.integration
def test_what_is_compiled_is_called_directly_and_compiled_again_for_another_form():
    step = Compiled(scaled_in_place, what="steps run", changes=(1,))
    for size in (3, 5):
        values, factor = torch.ones(size), torch.tensor(2.0)
        for times in (1, 2, 3):
            total = step((size,), Holds, values, factor)
            assert values.tolist() == [2.0**times] * size
            assert total == size * 2.0**times + 1
        assert step.enabled
        assert not hasattr(step._compiled, "_torchdynamo_orig_callable"), "torch's own wrapper is gone"
    torch._dynamo.reset()  # as someone else in the process may
    assert step((5,), Holds, values, factor) == 5 * 2.0**4 + 1


@pytest.mark.integration
def test_two_of_one_function_do_not_disturb_each_other():
    small, large = (Compiled(scaled_in_place, what="steps run", changes=(1,)) for _ in range(2))
    factor = torch.tensor(3.0)
    for _ in range(2):
        assert small((), Holds, torch.ones(2), factor) == 7
        assert large((), Holds, torch.ones(4), factor) == 13


def through_a_module(owner, values, keeps):
    """What a module gives with weights that were computed, as a lane's are."""
    with TensorDict({"weight": values.clone()}).to_module(owner, preserve_module_state=keeps):
        return owner.weight.detach() * 1


class Holder(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(3))


@pytest.mark.integration
def test_weights_put_into_a_module_as_tensordict_does_by_default_do_not_compile_and_the_cure_is_said():
    by_default, cured = (Compiled(through_a_module, what="steps run") for _ in range(2))
    with pytest.warns(RuntimeWarning, match="preserve_module_state=False"):
        assert by_default((True,), Holder(), torch.full((3,), 2.0), True).tolist() == [2.0] * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert cured((False,), Holder(), torch.full((3,), 2.0), False).tolist() == [2.0] * 3
    assert (by_default.enabled, cured.enabled) == (False, True)


@pytest.fixture
def compiles_as(monkeypatch):
    """Puts a function in place of what torch.compile would give."""
    return lambda function: monkeypatch.setattr(compiling.torch, "compile", lambda *_, **__: function)


@pytest.mark.integration
def test_a_compiled_function_that_gives_other_numbers_is_found_out(compiles_as):
    values = [torch.ones(3), torch.ones(2)]
    step = Compiled(scaled_both, what="steps run", changes=(1,))
    compiles_as(lambda owner, both, factor: [one.mul_(2.5) for one in both] and both[0].sum())
    with pytest.warns(RuntimeWarning, match=r"differ by up to 1\.5 from uncompiled code, steps run unc"):
        first = step((), Holds, values, torch.tensor(2.0))
    assert first == 6
    assert [one.tolist() for one in values] == [[2.0] * 3, [2.0] * 2]
    assert step((), Holds, values, torch.tensor(2.0)) == 12
    assert [one.tolist() for one in values] == [[4.0] * 3, [4.0] * 2]
    assert not step.enabled


def scaled_both(owner, both, factor):
    for one in both:
        one.mul_(factor)
    return both[0].sum()


def test_a_wrong_result_is_found_out_though_nothing_else_is_changed(compiles_as):
    compiles_as(lambda values: values * 1.01)
    double = Compiled(lambda values: values * 1.0, what="steps run")
    with pytest.warns(RuntimeWarning, match="differ by up to 0.03"):
        assert double((), torch.arange(4.0)).tolist() == [0, 1, 2, 3]


def test_comparing_draws_no_random_numbers_and_a_function_that_does_is_not_compared(compiles_as):
    def noisy(values):
        return values + torch.rand(3)

    compiles_as(lambda values: values + torch.rand(3) ** 2)  # as a compiler may, by numbers of its own
    step = Compiled(noisy, what="steps run")
    torch.manual_seed(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        came = step((), torch.zeros(3))
    torch.manual_seed(5)
    assert torch.equal(came, torch.rand(3) ** 2)
    assert step.enabled


def test_what_rounding_does_is_no_difference():
    wanted = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    assert largest_difference([wanted * (1 + 1e-6)], [wanted]) is None
    lonely = wanted.clone()
    lonely[3] += 1
    assert largest_difference([lonely], [wanted]) is None, "one of a thousand, a step of Adam's"
    assert largest_difference([wanted + 1], [wanted]) == pytest.approx(1, rel=1e-6)
    assert largest_difference([torch.tensor([1e-6])], [torch.tensor([2e-6])]) == pytest.approx(1e-6), (
        "small numbers are compared among their like"
    )
    nan = torch.full((3,), torch.nan)
    assert largest_difference([nan], [nan]) is None
    assert largest_difference([torch.ones(3)], [nan]) is not None


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
    training = Training(env, {AGENTS: learner}, Schedule(episodes=10**6))
    with warnings.catch_warnings():
        for kind in (DeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", kind)
        while training.steps < steps:
            training.step()
    assert learner.lane_networks._compiled.enabled
    return learner


def digest(learner):
    """Of all weights, targets, moments and stored transitions, to the bit."""
    networks = learner.lane_networks
    tensors = [
        *networks.params.values(),
        *networks.targets.values(),
        *networks.means.values(),
        *networks.squares.values(),
    ]
    tensors += learner.memory.buffer.fields.values()
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
    assert sorted(compilations) == ["_explore_of_its_own", "_step_of_its_own"]
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
    own = {tensor.data_ptr() for tensor in first.lane_networks.params.values()}
    assert own.isdisjoint(tensor.data_ptr() for tensor in second.lane_networks.params.values())


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
    monkeypatch.setattr(compiling, "guards_hold", lambda *_: True)
    assert shared_call(Owner()) == [4.0] * 3
    assert shared_call(Owner(3.0)) == [6.0] * 3
    assert len(compilations) == 2


if __name__ == "__main__":
    print(digest(trained(sys.argv[1], seed=int(sys.argv[2]))))
