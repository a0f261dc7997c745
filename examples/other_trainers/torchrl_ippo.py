"""Independent PPO of four agents on `commons`, out of the parts of TorchRL's multi-agent tutorial."""

from math import prod

import torch
import tyro
from tensordict.nn import TensorDictModule
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.modules import MultiAgentMLP, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from cprl import CommonsEnv, keys, presets

LOGITS = ("agents", "logits")
VALUE = ("agents", "state_value")
LOG_PROB = ("agents", "log_prob")
RETURN = ("agents", "return")
ENDS = {"done": ("agents", "done"), "terminated": ("agents", "terminated")}


class OwnMLPs(MultiAgentMLP):
    """A network for each agent: windows, uint8 [..., N, C, X, Y], to [..., N, outputs]."""

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return super().forward(windows.flatten(-3) / 255)


def main(*, iterations: int = 20, worlds: int = 16, seed: int = 0) -> list[float]:
    """Train on an episode in every world per iteration; return the harvest of an agent in each."""
    torch.manual_seed(seed)
    game = presets.game("commons")
    env = TransformedEnv(CommonsEnv(game, worlds, seed=seed), RewardSum([keys.REWARD], [RETURN]))
    sizes = {"n_agents": game.agents, "centralized": False, "share_params": False, "num_cells": [64, 64]}
    networks = (OwnMLPs(prod(game.observation_shape), n, **sizes) for n in (len(game.actions), 1))
    logits, value = map(TensorDictModule, networks, [[keys.OBSERVATION]] * 2, [[LOGITS], [VALUE]])
    names = {"out_keys": [keys.ACTION], "log_prob_key": LOG_PROB, "return_log_prob": True}
    actor = ProbabilisticActor(logits, {"logits": LOGITS}, distribution_class=Categorical, **names)
    loss = ClipPPOLoss(actor, value, entropy_coeff=0.01)
    loss.set_keys(action=keys.ACTION, sample_log_prob=LOG_PROB, value=VALUE, reward=keys.REWARD, **ENDS)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    adam = torch.optim.Adam(loss.parameters(), lr=1e-3)
    frames = worlds * game.rules.episode_steps
    sizes = {"frames_per_batch": frames, "total_frames": iterations * frames}
    harvests = []
    for batch in Collector(env, actor, **sizes, auto_register_policy_transforms=False):
        later = batch["next"]
        for end, key in ENDS.items():  # [B, T, 1] to [B, T, N, 1], as the rewards are
            later[key] = later[end].unsqueeze(-2).expand(later[keys.REWARD].shape)
        with torch.no_grad():
            loss.value_estimator(batch, params=loss.critic_network_params)
        for rows in [rows for _ in range(4) for rows in torch.randperm(frames).chunk(16)]:
            terms = loss(batch.reshape(-1)[rows])
            adam.zero_grad()
            (terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]).backward()
            adam.step()
        harvests.append(later[RETURN][later[ENDS["done"]]].mean().item())
        print(f"iteration {len(harvests)}: an agent harvests {harvests[-1]:.1f} in an episode", flush=True)
    return harvests


if __name__ == "__main__":
    tyro.cli(main)
