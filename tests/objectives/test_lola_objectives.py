"""LOLA and DiCE on games whose answers are known: by hand, by linear algebra, by listing all courses.

Published figures are those of Foerster et al., "Learning with Opponent-Learning Awareness" (2018), table 3:
200 updates of 50 runs, mean return per turn (standard deviation): on the iterated prisoner's dilemma naive
learners -1.98 (0.14), LOLA -1.06 (0.19); on iterated matching pennies 0 for both.
"""

from itertools import product

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor

from cprl.objectives import (
    LOLADiCELoss,
    LOLALoss,
    dice_objective,
    loaded_dice,
    lola_gradients,
    look_ahead_losses,
    looked_ahead,
    magic_box,
)
from cprl.objectives.functional import FunctionalLoss, weights_of


def iterated_value(probabilities, payoffs, *, gamma):
    """The discounted return of each of N agents who repeat a matrix game for ever, [.., N].

    It is p_0 (I - gamma P)^-1 r, where p_0 has the chances of the joint actions of the first turn, row a of P
    those of the turn after the joint action a, and r the payoffs. `probabilities` are those of the actions of
    each agent, [.., N, A**N + 1, A], after each joint action; in the last row, at the first turn.
    """
    paid = torch.as_tensor(payoffs, dtype=probabilities.dtype)
    agents, joint = paid.ndim - 1, paid.shape[0] ** (paid.ndim - 1)
    chances = probabilities[..., 0, :, :]
    for agent in range(1, agents):
        chances = (chances.unsqueeze(-1) * probabilities[..., agent, :, None, :]).flatten(-2)
    after, first = chances[..., :joint, :], chances[..., joint, :]
    return torch.linalg.solve(torch.eye(joint).to(after) - gamma * after.mT, first) @ paid.reshape(
        joint, agents
    )


DILEMMA = (((-1, -1), (-3, 0)), ((0, -3), (-2, -2)))
"""Payoffs of the prisoner's dilemma: action 0 cooperates, 1 defects."""
PENNIES = (((1, -1), (-1, 1)), ((-1, 1), (1, -1)))
SEEN_BY_SECOND = [0, 2, 1, 3, 4]
"""The joint actions, then the first turn, as the second agent numbers them: its own action first."""


def tandem(parameters):
    """L_1 = (x + y)^2 - 2 x and L_2 = (x + y)^2 - 2 y."""
    (x,), (y,) = parameters
    return torch.stack([(x + y) ** 2 - 2 * x, (x + y) ** 2 - 2 * y], -1)


def numbers(parameters):
    return [float(value.detach()) for (value,) in parameters]


def descended(objective, parameters, *, updates, step, rate):
    """Parameters after so many updates."""
    for _ in range(updates):
        slopes = lola_gradients([objective], parameters, rate=rate)
        parameters = [
            [value - step * slope for value, slope in zip(values, slopes_of_agent, strict=True)]
            for values, slopes_of_agent in zip(parameters, slopes, strict=True)
        ]
    return parameters


@pytest.mark.parametrize(
    ("rate", "place", "loss"),
    # With s = x + y: dL_1/dx = 2 s - 2, dL_1/dy = 2 s, d2L_2/dx dy = 2. LOLA adds -rate 2 s 2: it rests where
    # 2 s - 2 = 0.1 4 s, s = 1.25; the mean loss is s^2 - s.
    [(0.0, 1.0, 0.0), (0.1, 1.25, 0.3125)],
)
def test_the_tandem_game_ends_where_each_learning_rule_is_known_to_end(rate, place, loss):
    start = [[torch.tensor(0.3, dtype=torch.float64)], [torch.tensor(-0.7, dtype=torch.float64)]]
    end = descended(tandem, start, updates=200, step=0.1, rate=rate)
    assert float(end[0][0] + end[1][0]) == pytest.approx(place, abs=1e-6)
    assert float(tandem(end).mean()) == pytest.approx(loss, abs=1e-6)


def test_looking_ahead_to_first_order_is_exact_where_losses_are_linear_in_the_others_step():
    # L_1 = x y, L_2 = -x y: y steps to y + rate x, so L_1 ahead is x y + rate x^2, its gradient y + 2 rate x
    def bilinear(parameters):
        (x,), (y,) = parameters
        return torch.stack([x * y, -x * y], -1)

    at = [[torch.tensor(2.0, requires_grad=True)], [torch.tensor(3.0, requires_grad=True)]]
    assert numbers(looked_ahead(bilinear, at, rate=0.5)) == [2 - 0.5 * 3, 3 + 0.5 * 2]
    assert numbers(looked_ahead(bilinear, at, rate=0.5, fixed_agent=0)) == [2, 4]
    look_ahead_losses(bilinear, [bilinear] * 2, at, rate=0.5).sum().backward()
    # For y: x steps to x - rate y, so L_2 ahead is -x y + rate y^2, its gradient -x + 2 rate y.
    assert [float(value.grad) for (value,) in at] == [3 + 2 * 0.5 * 2, -2 + 2 * 0.5 * 3]
    # LOLA takes how much the other's step matters as a constant: y + rate x, and -x + rate y.
    slopes = lola_gradients([bilinear], at, rate=0.5)
    assert [float(slope) for (slope,) in slopes] == [3 + 0.5 * 2, -2 + 0.5 * 3]
    assert bilinear(at).tolist() == [6, -6]


def test_with_three_agents_the_terms_of_all_others_are_summed():
    # L_i = x y z each; agent 1 expects y - rate x z, z - rate x y, and to first order the loss
    # x y z - rate ((x z)(x z) + (x y)(x y)), with the first of each two factors constant:
    # y z - rate (x z z + x y y).
    def together(parameters):
        (x,), (y,), (z,) = parameters
        return (x * y * z).expand(3)

    at = [[torch.tensor(value)] for value in (2.0, 3.0, 5.0)]
    slopes = lola_gradients([together], at, rate=0.1)
    x, y, z = 2, 3, 5
    wanted = [
        y * z - 0.1 * (x * z * z + x * y * y),
        x * z - 0.1 * (y * z * z + y * x * x),
        x * y - 0.1 * (z * x * x + z * y * y),
    ]
    assert [float(slope) for (slope,) in slopes] == pytest.approx(wanted)


def policies(parameters):
    """Probabilities [.., 2, 5, 2] of policies whose logits of action 0 are parameters [.., 5]; each agent
    numbers joint actions with its own action first."""
    first, second = parameters[0][0], parameters[1][0][..., SEEN_BY_SECOND]
    chance = torch.stack([first, second], -2).sigmoid()
    return torch.stack([chance, 1 - chance], -1)


def losses_of(payoffs, gamma):
    return lambda parameters: -iterated_value(policies(parameters), payoffs, gamma=gamma)


def test_the_value_of_tit_for_tat_and_of_defection_is_as_by_hand():
    keeps, never = torch.tensor([1.0, 0, 1, 0, 1]), torch.zeros(5)
    # Against who always defects, tit for tat (numbered own action first: C after CC and DC) loses once 3 and
    # then 2 a turn: -3 - 2 g / (1 - g); the other gains 0 once and then -2.
    of_each = torch.stack([torch.stack([keeps, 1 - keeps], -1), torch.stack([never, 1 - never], -1)])
    assert iterated_value(of_each, DILEMMA, gamma=0.5).tolist() == pytest.approx([-5, -2])
    both = torch.stack([of_each[0], of_each[0][SEEN_BY_SECOND]])
    assert iterated_value(both, DILEMMA, gamma=0.5).tolist() == pytest.approx([-2, -2])


def ends(payoffs, gamma):
    """Mean payoffs a turn of 1000 pairs after 200 updates, [1000, 2], of naive learners and of LOLA."""
    generator = torch.Generator().manual_seed(1)
    start = [[torch.randn(1000, 5, generator=generator)] for _ in range(2)]
    objective = losses_of(payoffs, gamma)
    return [
        -objective(descended(objective, start, updates=200, step=1.0, rate=rate)) * (1 - gamma)
        for rate in (0.0, 1.0)
    ]


@pytest.mark.slow
def test_exact_lola_finds_cooperation_in_the_iterated_dilemma_and_naive_learning_does_not():
    naive, lola = (values.mean(-1) for values in ends(DILEMMA, 0.96))
    # Published -1.98 (0.14) and -1.06 (0.19) over 50 runs each; these are 20 times 50.
    assert naive.mean() < -1.9
    assert lola.mean() > -1.15
    assert (lola > -1.2).float().mean() >= 0.85


@pytest.mark.slow
def test_exact_lola_and_naive_learning_stay_near_zero_in_matching_pennies():
    naive, lola = ends(PENNIES, 0.9)
    assert max(values.mean(0).abs().max() for values in (naive, lola)) < 0.05, "published: 0 for both"
    assert lola[:, 0].std() < naive[:, 0].std() / 2, "LOLA comes to the equilibrium, where each run has 0"


T, GAMMA = 3, 0.9
POINT = [
    [torch.tensor([0.5, -1.0, 0.3, -0.2, 0.8], dtype=torch.float64)],
    [torch.tensor([-0.4, 0.6, -0.9, 0.1, 0.2], dtype=torch.float64)],
]
"""Where gradients are compared: logits of cooperating, by what an agent saw."""
JOINT = [2 * a + b for a, b in product(range(2), range(2))]


def listed(parameters):
    """The losses of T turns of the dilemma, by listing all 4**T courses; [2]."""
    chances, paid = policies(parameters), torch.tensor(DILEMMA, dtype=torch.float64).reshape(4, 2)
    joint = (chances[0].unsqueeze(-1) * chances[1].unsqueeze(-2)).flatten(-2)
    value = torch.zeros(2, dtype=torch.float64)
    for course in product(JOINT, repeat=T):
        chance, last, worth = torch.ones((), dtype=torch.float64), 4, torch.zeros(2, dtype=torch.float64)
        for turn, now in enumerate(course):
            chance, last, worth = chance * joint[last, now], now, worth + GAMMA**turn * paid[now]
        value = value + chance * worth
    return -value


def sampled(lanes, rollouts, seed):
    """Rollouts [lanes, rollouts, T]: the joint actions seen, actions [.., 2] and rewards [.., 2]."""
    generator = torch.Generator().manual_seed(seed)
    chances = policies(POINT)[..., 0]
    last = torch.full((lanes, rollouts), 4)
    seen, actions = [], []
    for _ in range(T):
        dice = torch.rand(lanes, rollouts, 2, generator=generator, dtype=torch.float64)
        action = (dice >= chances[:, last].movedim(0, -1)).long()
        seen.append(last)
        actions.append(action)
        last = 2 * action[..., 0] + action[..., 1]
    action = torch.stack(actions, 2)
    paid = torch.tensor(DILEMMA, dtype=torch.float64)[action[..., 0], action[..., 1]]
    return torch.stack(seen, 2), action, paid


def to_go(paid):
    """Discounted rewards from each turn to the end."""
    returns = torch.zeros_like(paid)
    for turn in reversed(range(T)):
        later = GAMMA * returns[:, :, turn + 1] if turn + 1 < T else 0
        returns[:, :, turn] = paid[:, :, turn] + later
    return returns


BASELINE = torch.tensor([-3.0, -2.0, -1.0], dtype=torch.float64)[:, None].expand(T, 2)
"""Of the return from each turn on: far off, since it must not matter."""


def estimate(rollouts, kind):
    """Losses [lanes, 2] by parameters [lanes, 5] of each agent."""
    seen, action, paid = rollouts

    def losses(parameters):
        logits = torch.stack([parameters[0][0], parameters[1][0][..., SEEN_BY_SECOND]], 1)
        at = seen.flatten(1).unsqueeze(1).expand(-1, 2, -1)
        logit = logits.gather(-1, at).unflatten(-1, seen.shape[1:]).movedim(1, -1)
        taken = nn.functional.logsigmoid(torch.where(action == 0, logit, -logit))
        if kind == "loaded":
            value = loaded_dice(taken, to_go(paid) - BASELINE, gamma=GAMMA)
        else:
            value = dice_objective(taken, paid, gamma=GAMMA)
        return -value.mean(-2)

    return losses


def of_lanes(lanes):
    return [[own.expand(lanes, -1).clone().requires_grad_()] for (own,) in POINT]


def derivatives(objective, parameters):
    """Of the losses [.., 2] dL_1/dx, dL_1/dy and d2L_2/dx dy, flat [.., 35]; agent 1 has x, agent 2 has y."""
    (x,), (y,) = parameters
    losses = objective(parameters)
    first = torch.autograd.grad(losses[..., 0].sum(), (x, y), retain_graph=True)
    (step,) = torch.autograd.grad(losses[..., 1].sum(), y, create_graph=True)
    mixed = [torch.autograd.grad(step[..., k].sum(), x, retain_graph=True)[0] for k in range(5)]
    return torch.cat([*first, *mixed], -1)


def assert_unbiased(estimates, exact, errors=4.5):
    """The mean of estimates [lanes, ..] is as near to the exact value as its standard error lets expect."""
    error = estimates.std(0) / len(estimates) ** 0.5
    off = (estimates.mean(0) - exact).abs() / error.clamp(min=1e-12)
    assert off.max() < errors, f"{off.max():.1f} standard errors off"
    return error


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["plain", "loaded"])
def test_dice_estimates_first_and_mixed_second_derivatives_without_bias(kind):
    exact = derivatives(listed, [[own.clone().requires_grad_()] for (own,) in POINT])
    found = derivatives(estimate(sampled(4000, 25, seed=3), kind), of_lanes(4000))
    error = assert_unbiased(found, exact)
    assert error.max() < 0.02, "100,000 rollouts tell derivatives of up to 0.5 from 0"
    assert exact.abs().max() > 0.2


@pytest.mark.integration
def test_two_batches_estimate_lolas_gradient_without_bias_and_one_batch_does_not():
    lanes, rate = 20_000, 1.0
    exact = torch.cat([slope for (slope,) in lola_gradients([listed], POINT, rate=rate)])
    estimates = [estimate(sampled(lanes, 4, seed=seed), "plain") for seed in (5, 6)]
    values = [[own.detach() for own in of] for of in of_lanes(lanes)]
    found = {
        batches: torch.cat([of for (of,) in lola_gradients(estimates[:batches], values, rate=rate)], -1)
        for batches in (1, 2)
    }
    assert_unbiased(found[2], exact)
    error = found[1].std(0) / lanes**0.5
    assert ((found[1].mean(0) - exact).abs() / error).max() > 10, "the product of one batch is biased"


def test_pieces_of_a_rollout_do_not_influence_each_other():
    torch.manual_seed(2)
    logits, paid = torch.randn(2, 7, 2, requires_grad=True), torch.randn(2, 7, 2)
    done = torch.tensor([0, 0, 1, 0, 0, 0, 0], dtype=torch.bool)[:, None].expand(2, 7, 1)
    together = dice_objective(logits, paid, gamma=0.9, done=done)
    parts = [slice(0, 3), slice(3, 7)]
    apart = [dice_objective(logits[:, part], paid[:, part], gamma=0.9) for part in parts]
    torch.testing.assert_close(together, (apart[0] + apart[1]) / 2)

    def second(value):
        (slope,) = torch.autograd.grad(value[..., 0].sum(), logits, create_graph=True)
        return torch.autograd.grad(slope.square().sum(), logits, retain_graph=True)[0]

    torch.testing.assert_close(second(together), second((apart[0] + apart[1]) / 2))
    # Of one agent, rewards 1 2 4, gamma 1/2: 1 + 2/2 + 4/4 = 3.
    one = torch.tensor([1.0, 2.0, 4.0])[:, None]
    assert dice_objective(torch.zeros(3, 1), one, gamma=0.5).tolist() == [3.0]
    last = torch.tensor([True, False, False])[:, None]
    # Two pieces: 1, and 2 + 4/2 = 4; their mean is 2.5.
    assert dice_objective(torch.zeros(3, 1), one, gamma=0.5, done=last).tolist() == [2.5]


def test_the_magic_box_is_one_and_has_the_derivatives_of_a_relative_probability():
    x = torch.tensor(0.3, requires_grad=True)
    box = magic_box(2 * x)
    (slope,) = torch.autograd.grad(box, x, create_graph=True)
    (curve,) = torch.autograd.grad(slope, x)
    assert [float(value.detach()) for value in (box, slope, curve)] == [1, 2, 4]


def actor():
    net = TensorDictModule(nn.Linear(3, 2), ["observation"], ["logits"])
    of = torch.distributions.Categorical
    return ProbabilisticActor(net, in_keys=["logits"], out_keys=["action"], distribution_class=of)


def batch(*size, agents=2):
    return TensorDict(
        {
            "observation": torch.randn(*size, agents, 3),
            "action": torch.randint(2, (*size, agents)),
            "advantage": torch.randn(*size, agents, 1),
            "done": torch.rand(*size, 1) < 0.2,
        },
        size,
    )


def objective_by_hand(rollouts):
    """The losses of two linear policies over rollouts [B, T], by weights and biases."""

    def losses(parameters):
        taken = [
            torch.distributions.Categorical(
                logits=rollouts["observation"][..., i, :] @ weight.T + bias
            ).log_prob(rollouts["action"][..., i])
            for i, (weight, bias) in enumerate(parameters)
        ]
        advantage = rollouts["advantage"].squeeze(-1)
        return -loaded_dice(torch.stack(taken, -1), advantage, gamma=0.9, done=rollouts["done"]).mean(-2)

    return losses


def test_the_loss_has_lolas_gradient_under_backward_under_func_grad_and_vmapped():
    torch.manual_seed(0)
    actors, rollouts = [actor(), actor()], batch(4, 6)
    loss = LOLALoss(actors, look_ahead_rate=2.0, gamma=0.9)
    found = loss(rollouts)
    assert [float(found[name].detach()) for name in ("loss_objective", "loss_entropy")] == [0, 0]
    found["loss_objective"].backward()
    parameters = [[own.weight, own.bias] for own in (one.module[0].module for one in actors)]
    wanted = lola_gradients(
        [objective_by_hand(half) for half in rollouts.chunk(2)],
        [[own.detach() for own in of] for of in parameters],
        rate=2.0,
    )
    torch.testing.assert_close([[own.grad for own in of] for of in parameters], wanted)
    functional, weights = FunctionalLoss(loss), weights_of(LOLALoss(actors))
    slopes = torch.func.grad(lambda own: functional(own, rollouts))(weights)
    torch.testing.assert_close(slopes["actors_params:1.module.0.module.weight"], parameters[1][0].grad)
    lanes = {name: torch.stack([value, value]) for name, value in weights.items()}
    slopes = torch.func.vmap(torch.func.grad(lambda own: functional(own, rollouts)))(lanes)
    torch.testing.assert_close(slopes["actors_params:0.module.0.module.bias"][1], parameters[0][1].grad)


def test_dice_is_lola_where_all_its_rollouts_are_one_batch_and_the_step_is_small():
    # dL_i/dtheta_i - rate (dL_i/dtheta_j) d2L_j/dtheta_j dtheta_i, with dL_i/dtheta_j at the weights ahead.
    # That dL_i/dtheta_i too is one at the weights ahead is seen in fresh rollouts alone, which these are not.
    torch.manual_seed(0)
    actors, rollouts, rate = [actor(), actor()], batch(4, 6), 1e-3
    loss = LOLADiCELoss(actors, look_ahead_rate=rate, gamma=0.9)
    loss(torch.stack([rollouts] * 3))["loss_objective"].backward()
    parameters = [[own.weight, own.bias] for own in (one.module[0].module for one in actors)]
    start = [[own.detach().double() for own in of] for of in parameters]
    same = objective_by_hand(
        rollouts.apply(lambda value: value.double() if value.is_floating_point() else value)
    )
    wanted = lola_gradients([same], start, rate=rate)
    naive = lola_gradients([same], start, rate=0.0)
    for of, slopes, plain in zip(parameters, wanted, naive, strict=True):
        for own, slope, first in zip(of, slopes, plain, strict=True):
            extra = (slope - first) / rate
            torch.testing.assert_close((own.grad.double() - first) / rate, extra, atol=0.02, rtol=0.02)
    ahead = loss.look_ahead(rollouts)
    stepped = looked_ahead(same, start, rate=rate)
    torch.testing.assert_close(ahead[1]["module", "0", "module", "bias"].double(), stepped[1][1])


def test_entropy_draws_policies_towards_chance_and_entries_can_be_renamed():
    torch.manual_seed(0)
    actors, rollouts = [actor(), actor()], batch(2, 6)
    loss = LOLALoss(actors, look_ahead_rate=0.0, entropy_coeff=0.5)
    found = loss(rollouts)
    torch.testing.assert_close(found["loss_entropy"], -0.5 * found["entropy"].sum())
    assert found["entropy"].shape == (2,)
    nested = TensorDict({"agents": rollouts.exclude("done"), "over": rollouts["done"]}, [2, 6])
    names = {name: ("agents", name) for name in ("observation", "action", "advantage")}
    loss.set_keys(**names, done="over")
    assert loss.in_keys == [*names.values(), "over"]
    torch.testing.assert_close(loss(nested)["loss_entropy"], found["loss_entropy"])


def test_rollouts_that_do_not_fit_are_refused():
    actors = [actor(), actor()]
    with pytest.raises(ValueError, match=r"rollouts are \[3, 4\]"):
        LOLALoss(actors)(batch(3, 4))
    with pytest.raises(ValueError, match=r"rollouts are \[2, 1, 4\]"):
        LOLADiCELoss(actors)(batch(2, 1, 4))
