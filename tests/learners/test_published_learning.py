"""How versions of the study's program learned: RMSprop as Keras has it, and the log-cosh of errors."""

import math
from dataclasses import replace
from typing import get_args

import pytest
import torch
from cql import CQL
from dqn_parts import make_learner, transitions
from iql import IQL
from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, ValueEstimators

from cprl import presets
from cprl.algorithms import DQN, MADDPG, PR2, SAC, DQNSettings
from cprl.learners.optimizers import UpdateRule, torch_optimizer
from cprl.objectives import LogCoshDQNLoss, log_cosh
from cprl.objectives.td import Distance, td_distance
from cprl.system.compat.torchrl import promise_targets

# Two steps of Keras's RMSprop with rho 0.9, learning rate 0.1 and, to see where it stands, epsilon 0.5, from
# the weight 1 along the gradients 2 and -1:
# the mean of squares is 0.1 * 4 = 0.4, its root 0.6324555; 1 - 0.1 * 2 / (0.6324555 + 0.5) = 0.8233926;
# then 0.9 * 0.4 + 0.1 * 1 = 0.46, its root 0.6782330; 0.8233926 + 0.1 / (0.6782330 + 0.5) = 0.9082655.
# (Inside of the root epsilon would give 1 - 0.2 / sqrt(0.9) = 0.7891815 after the first.)
KERAS = UpdateRule(optimizer="keras_rmsprop", learning_rate=0.1, adam_eps=0.5)
GRADIENTS, WEIGHTS, SQUARES = (2.0, -1.0), (0.8233926, 0.9082655), (0.4, 0.46)


def test_torchs_optimiser_takes_the_steps_of_keras():
    weight = nn.Parameter(torch.ones(1, dtype=torch.float64))
    optimizer = torch_optimizer(KERAS, [weight])
    assert type(optimizer) is torch.optim.RMSprop
    for gradient, after, square in zip(GRADIENTS, WEIGHTS, SQUARES, strict=True):
        weight.grad = torch.full_like(weight, gradient)
        optimizer.step()
        assert weight.item() == pytest.approx(after, abs=1e-7)
        assert optimizer.state[weight]["square_avg"].item() == pytest.approx(square)
    assert set(optimizer.state[weight]) == {"step", "square_avg"}, "no momentum, not centred"


def test_log_cosh_and_its_derivative_are_those_worked_by_hand_and_never_overflow():
    # e^d is 2, 1/3, 1: cosh d is (2 + 1/2) / 2 = 5/4, (3 + 1/3) / 2 = 5/3, 1; tanh d is (4 - 1) / (4 + 1),
    # (1/9 - 1) / (1/9 + 1), 0. Of large errors it is |d| - ln 2.
    for dtype, large in ((torch.float64, 90.0), (torch.float32, 1e30)):
        error = torch.tensor([math.log(2), -math.log(3), 0.0, large, -large], dtype=dtype, requires_grad=True)
        loss = log_cosh(error)
        assert loss.dtype == dtype
        by_hand = [math.log(5 / 4), math.log(5 / 3), 0.0, *[large - math.log(2)] * 2]
        assert loss.tolist() == pytest.approx(by_hand)
        loss.sum().backward()
        assert error.grad[:3].tolist() == pytest.approx([0.6, -0.8, 0.0])
        assert error.grad[3:].tolist() == [1.0, -1.0]
    error = torch.linspace(-20, 20, 4001, requires_grad=True)
    log_cosh(error).sum().backward()
    torch.testing.assert_close(error.grad, error.detach().tanh(), rtol=0, atol=3e-7)


def test_every_distance_is_that_of_torchrl_or_log_cosh():
    value, target = torch.tensor([1.0, 3.0]), torch.tensor([2.0, 3.0])
    # ln cosh 1 = ln 1.5430806 = 0.4337808.
    of_one = {"l1": 1.0, "l2": 1.0, "smooth_l1": 0.5, "log_cosh": 0.4337808}
    assert set(of_one) == set(get_args(Distance))
    for name, expected in of_one.items():
        assert td_distance(value, target, name).tolist() == pytest.approx([expected, 0.0])


class Table(nn.Module):
    """Values 0.25 and 0.5 of two actions, whatever is seen."""

    def __init__(self):
        super().__init__()
        self.values = nn.Parameter(torch.tensor([0.25, 0.5], dtype=torch.float64))

    def forward(self, observation):
        return self.values.expand(*observation.shape[:-1], 2)


def dqn_of_a_table(**how):
    actor = QValueActor(Table(), spec=None, action_space="categorical")
    loss = LogCoshDQNLoss(actor, delay_value=True, action_space="categorical", **how)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.5)
    promise_targets(loss)
    return loss


def two_turns():
    seen, reward = torch.zeros(2, 1).double(), torch.tensor([[1.0], [-0.5]]).double()
    return transitions(seen, [0, 1], seen, reward, [[False], [True]])


@pytest.mark.parametrize("double", [False, True])
def test_the_loss_of_a_batch_is_the_mean_log_cosh_of_its_errors(double):
    # Targets are 1 + 0.5 * 0.5 = 1.25 and, after the end, -0.5, so both errors are 1: 0.25 - 1.25 = -1 and
    # 0.5 + 0.5 = 1. ln cosh 1 = 0.4337808, tanh 1 = 0.7615942, of which the mean has half in each value.
    loss = dqn_of_a_table(double_dqn=double)
    out = loss(two_turns())["loss"]
    assert out.item() == pytest.approx(0.4337808)
    out.backward()
    values = loss.value_network_params.flatten_keys(".").values()
    assert next(iter(values)).grad.tolist() == pytest.approx([-0.7615942 / 2, 0.7615942 / 2])
    assert dqn_of_a_table(reduction="sum")(two_turns())["loss"].item() == pytest.approx(2 * 0.4337808)
    each = dqn_of_a_table(reduction="none")(two_turns())["loss"]
    assert each.tolist() == pytest.approx([0.4337808] * 2)


def test_the_loss_is_torchrls_in_all_else():
    loss, batch = dqn_of_a_table(), two_turns()
    assert isinstance(loss, DQNLoss)
    loss(batch)
    assert batch["td_error"].squeeze(-1).tolist() == [1.0, 1.0], "squares, as priorities always are"
    weighed = two_turns().set("priority_weight", torch.tensor([3.0, 1.0], dtype=torch.float64))
    weighed["next", "reward"] = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    # The second error is now 0, and so its share: 3 / (3 + 1) of the first.
    assert loss(weighed)["loss"].item() == pytest.approx(0.75 * 0.4337808)


def test_as_run_the_loss_is_that_of_keras_over_all_outputs():
    """Keras fits all outputs to targets that equal them but for the action taken, and takes the mean over
    outputs, then over the batch."""
    settings = replace(presets.dqn_settings("two_complex", variant="as_run"), buffer_size=20)
    algorithm = DQN(settings=settings, loss_function="log_cosh")
    spaces = presets.game("two_complex", variant="as_run").spaces
    learner = make_learner(algorithm, spaces, agents=(0,), replicas=1, engine="torchrl")
    engine, chance = learner.lane_networks, torch.Generator().manual_seed(1)
    (loss,), (network,) = engine.losses, engine.parts[0]
    seen, seen_next = torch.randint(256, (2, 8, *spaces.observation_shape), generator=chance).to(torch.uint8)
    action, reward = torch.arange(8) % spaces.actions, torch.rand(8, 1, generator=chance)
    batch = transitions(seen, action, seen_next, reward, [[False]] * 8)
    with loss.target_value_network_params.to_module(loss.value_network):
        following = loss.value_network(batch["next"].select("observation"))["action_value"].amax(-1)
    outputs = network(seen).detach()
    targets = outputs.clone()
    targets[range(8), action] = reward.squeeze(-1) + settings.gamma * following
    assert engine.learn_agent(0, batch).item() == pytest.approx(
        log_cosh(outputs - targets).mean().item(), rel=1e-5
    )


@pytest.mark.parametrize("kind", [DQN, PR2, MADDPG])
def test_an_unknown_loss_function_is_refused_and_log_cosh_by_those_whose_losses_are_torchrls_own(kind):
    assert kind(settings=DQNSettings(), loss_function="log_cosh").loss_function == "log_cosh"
    for other, name in ((kind, "logcosh"), (CQL, "log_cosh"), (SAC, "log_cosh"), (IQL, "log_cosh")):
        with pytest.raises(ValueError, match=f"{other.__name__}.loss_function is '{name}'"):
            other(settings=DQNSettings(), loss_function=name)
