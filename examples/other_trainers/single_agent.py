"""One DQN agent alone on `single_basic`, out of TorchRL's stock parts."""

from math import prod

import torch
import tyro
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate

from cprl import CommonsEnv, keys, presets

FLAT = ("agents", "flat")
VALUES = ("agents", "action_value")
CHOSEN = ("agents", "chosen_action_value")
ENDS = {"done": ("agents", "done"), "terminated": ("agents", "terminated")}


def main(*, episodes: int = 40, seed: int = 0) -> dict[str, float]:
    """Train; return the harvest of an episode at random and greedily, means over 100 fresh worlds."""
    torch.manual_seed(seed)
    game = presets.game("single_basic")
    env = CommonsEnv(game, seed=seed)
    turns = game.rules.episode_steps
    network = MLP(prod(game.observation_shape), len(game.actions), num_cells=[64, 64])
    pick = QValueModule("categorical", VALUES, out_keys=[keys.ACTION, VALUES, CHOSEN])
    flat = TensorDictModule(lambda windows: windows.flatten(-3) / 255, [keys.OBSERVATION], [FLAT])
    greedy = TensorDictSequential(flat, TensorDictModule(network, [FLAT], [VALUES]), pick)
    annealed = {"eps_end": 0.05, "annealing_num_steps": episodes * turns // 2}
    explore = EGreedyModule(env.full_action_spec_unbatched, action_key=keys.ACTION, **annealed)
    loss = DQNLoss(greedy, action_space="categorical")
    loss.set_keys(action=keys.ACTION, action_value=VALUES, value=CHOSEN, reward=keys.REWARD, **ENDS)
    loss.make_value_estimator(gamma=0.99)
    adam = torch.optim.Adam(loss.parameters(), lr=3e-4)
    target = SoftUpdate(loss, tau=0.005)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=64)
    sizes = {"frames_per_batch": turns, "total_frames": episodes * turns}
    sizes["auto_register_policy_transforms"] = False
    stock = Collector(env, TensorDictSequential(greedy, explore), **sizes)
    for episode, batch in enumerate(stock):
        for end, key in ENDS.items():  # [1, T, 1] to [1, T, 1, 1], as the rewards are
            batch["next", *key] = batch["next", end].unsqueeze(-1)
        buffer.extend(batch.reshape(-1))
        explore.step(turns)
        for _ in range(turns // 4):
            adam.zero_grad()
            loss(buffer.sample())["loss"].backward()
            adam.step()
            target.step()
        if episode % 10 == 9:
            print(f"episode {episode + 1}: harvest {batch['next', *keys.REWARD].sum():.0f}", flush=True)
    trial = CommonsEnv(game, 100, seed=seed + 1)
    played = {}
    for name, policy in {"random": None, "greedy": greedy}.items():
        steps = trial.rollout(turns, policy, break_when_any_done=False, break_when_all_done=True)["next"]
        playing = steps["done"].cumsum(1) - steps["done"].long() == 0  # a rollout repeats a world's last step
        played[name] = (steps[keys.HARVEST] * playing).sum().item() / 100
    return played


if __name__ == "__main__":
    print(tyro.cli(main))
