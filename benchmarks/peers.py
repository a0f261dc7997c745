"""How fast others learn the same: PPO of four agents with networks of their own in 256 worlds of `commons`.

Rollouts of 64 turns, 4 epochs, minibatches of 2,048 turns, two hidden layers of 32 units, one thread; env
steps a second of the processor, an env step being a turn of one world. "TorchRL's tutorial" is made of the
parts of its multi-agent PPO tutorial, as examples/other_trainers/torchrl_ippo.py is: `Collector`,
`MultiAgentMLP`, `ClipPPOLoss`, GAE. The plain loop is that of benchmarks/many_worlds.py.

    python benchmarks/peers.py [--rollouts 3]
"""

import sys
import time
from math import prod
from pathlib import Path
from statistics import median

import torch
import tyro
from many_worlds import AGENTS, GAME, MINIBATCH, PLAIN_WORLDS, TURNS, Plain, measure
from tensordict.nn import TensorDictModule
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from cprl import CommonsEnv, keys
from cprl.system.process import prepare_process

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "other_trainers"))
from torchrl_ippo import ENDS, LOG_PROB, LOGITS, VALUE, OwnMLPs


def tutorial(rollouts: int) -> float:
    """Return the median rate of TorchRL's parts, after a first rollout."""
    env = CommonsEnv(GAME, PLAIN_WORLDS, seed=0)
    sizes = {"n_agents": AGENTS, "centralized": False, "share_params": False, "num_cells": [32, 32]}
    outputs = GAME.spaces.actions, 1
    networks = (OwnMLPs(prod(GAME.observation_shape), count, **sizes) for count in outputs)
    logits, value = map(TensorDictModule, networks, [[keys.OBSERVATION]] * 2, [[LOGITS], [VALUE]])
    names = {"out_keys": [keys.ACTION], "log_prob_key": LOG_PROB, "return_log_prob": True}
    actor = ProbabilisticActor(logits, {"logits": LOGITS}, distribution_class=Categorical, **names)
    loss = ClipPPOLoss(actor, value, entropy_coeff=0.01)
    loss.set_keys(action=keys.ACTION, sample_log_prob=LOG_PROB, value=VALUE, reward=keys.REWARD, **ENDS)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    adam = torch.optim.Adam(loss.parameters(), lr=3e-4, fused=True)
    frames = PLAIN_WORLDS * TURNS
    sizes = {"frames_per_batch": frames, "total_frames": (1 + rollouts) * frames}
    rates = []
    began = time.process_time()
    for batch in Collector(env, actor, **sizes, auto_register_policy_transforms=False):
        later = batch["next"]
        for end, key in ENDS.items():
            later[key] = later[end].unsqueeze(-2).expand(later[keys.REWARD].shape)
        with torch.no_grad():
            loss.value_estimator(batch, params=loss.critic_network_params)
        flat = batch.reshape(-1)
        for rows in [rows for _ in range(4) for rows in torch.randperm(frames).split(MINIBATCH)]:
            terms = loss(flat[rows])
            adam.zero_grad()
            (terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]).backward()
            adam.step()
        rates.append(frames / (time.process_time() - began))
        began = time.process_time()
    return median(rates[1:])


def main(rollouts: int = 3) -> None:
    """Print the rates.

    Args:
        rollouts: of the tutorial, after the first.
    """
    prepare_process(0)
    plain = Plain()
    plain.rollout()
    rates = {
        "TorchRL's tutorial": tutorial(rollouts),
        "the plain loop, its loss compiled": median(plain.rate() for _ in range(3)),
        "cprl": measure("ppo-4", 2)["env steps/s"],
    }
    print("| program | env steps/s | agent steps/s |\n|---|---:|---:|")
    for program, rate in rates.items():
        print(f"| {program} | {rate:,.0f} | {AGENTS * rate:,.0f} |")


if __name__ == "__main__":
    tyro.cli(main)
