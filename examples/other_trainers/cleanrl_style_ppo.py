"""PPO in one file of plain torch, as CleanRL writes it: a network that the four agents of `commons` share."""

from math import prod

import torch
import tyro
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs import RewardSum, TransformedEnv

from cprl import CommonsEnv, keys, presets


def play(network: nn.Module, windows: Tensor) -> tuple[Categorical, Tensor]:
    """Return policy and value for windows, uint8 [..., C, X, Y]."""
    heads = network(windows.flatten(-3) / 255)
    return Categorical(logits=heads[..., :-1]), heads[..., -1]


def main(*, iterations: int = 20, worlds: int = 16, seed: int = 0) -> list[float]:
    """Train on an episode in every world per iteration; return the harvest of an agent in each."""
    torch.manual_seed(seed)
    game = presets.game("commons")
    env = TransformedEnv(CommonsEnv(game, worlds, seed=seed), RewardSum([keys.REWARD], ["return"]))
    first = nn.Linear(prod(game.observation_shape), 64)
    last = nn.Linear(64, len(game.actions) + 1)
    network = nn.Sequential(first, nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), last)
    now = env.reset()
    harvests = []
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)
    for iteration in range(iterations):
        turns = []
        with torch.no_grad():
            for _ in range(game.rules.episode_steps):
                policy, now["agents", "value"] = play(network, now[keys.OBSERVATION])
                now[keys.ACTION] = policy.sample()
                now["agents", "log_prob"] = policy.log_prob(now[keys.ACTION])
                turn, now = env.step_and_maybe_reset(now)
                turns.append(turn)
            agents, later = (torch.stack(turns)[part] for part in ("agents", "next"))  # [T, B, N], [T, B]
            after = play(network, later[keys.OBSERVATION])[1] * ~later["terminated"]
            surprise = later[keys.REWARD].squeeze(-1) + 0.99 * after - agents["value"]
            advantage = torch.zeros_like(surprise)
            ahead = 0  # bootstrapped where the clock ended an episode
            for t in reversed(range(len(turns))):
                advantage[t] = ahead = surprise[t] + 0.99 * 0.95 * ahead * ~later["done"][t]
            agents["advantage"] = advantage
            agents["target"] = advantage + agents["value"]
        for rows in [rows for _ in range(4) for rows in torch.randperm(agents.numel()).chunk(16)]:
            part = agents.reshape(-1)[rows]
            policy, value = play(network, part["observation"])
            ratio = (policy.log_prob(part["action"]) - part["log_prob"]).exp()
            gain = part["advantage"]
            gained = torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain) + 0.01 * policy.entropy()
            adam.zero_grad()
            (0.5 * (value - part["target"]).square() - gained).mean().backward()
            adam.step()
        harvests.append(later["return"].mean(-2)[later["done"]].mean().item())
        print(f"iteration {iteration + 1}: an agent harvests {harvests[-1]:.1f} in an episode", flush=True)
    return harvests


if __name__ == "__main__":
    tyro.cli(main)
