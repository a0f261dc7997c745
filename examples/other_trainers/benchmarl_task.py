"""`commons` as a task of BenchMARL, learned by its IPPO; docs/algorithms.md says how to install BenchMARL."""

from dataclasses import replace
from typing import Any

import torch
import tyro
from torchrl import collectors
from torchrl.envs import EnvBase, FlattenObservation, ObservationNorm, transforms

from cprl import CommonsEnv, keys, presets

collectors.SyncDataCollector = collectors.Collector  # the name by which BenchMARL 1.5.2 imports it
from benchmarl.algorithms import IppoConfig  # noqa: E402
from benchmarl.environments.vmas.common import VmasClass  # noqa: E402
from benchmarl.experiment import Experiment, ExperimentConfig  # noqa: E402
from benchmarl.models.mlp import MlpConfig  # noqa: E402


class CommonsTask(VmasClass):
    """A published game by its name: as in VMAS a batch of worlds with one group, "agents"."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: str) -> Any:
        return lambda: CommonsEnv(presets.game(self.name), num_envs, seed=seed, device=device)

    def get_env_transforms(self, env: EnvBase) -> list[transforms.Transform]:
        key = [keys.OBSERVATION]
        cast = transforms.DTypeCastTransform(torch.uint8, torch.float32, in_keys=key)
        flat = FlattenObservation(-3, -1, in_keys=key)
        scaled = ObservationNorm(0.0, 1 / 255, in_keys=key)
        return [transforms.SelectTransform(*key), cast, flat, scaled]

    def max_steps(self, env: EnvBase) -> int:
        return presets.game(self.name).rules.episode_steps

    def has_render(self, env: EnvBase) -> bool:
        return False

    def supports_continuous_actions(self) -> bool:
        return False


def main(*, iterations: int = 20, worlds: int = 16, seed: int = 0, out: str = ".") -> float:
    """Train on an episode in every world per iteration; return the last harvest of an agent."""
    task = CommonsTask("commons", {})
    stock = ExperimentConfig.get_from_yaml()
    frames = worlds * presets.game(task.name).rules.episode_steps
    length = {"max_n_iters": iterations, "max_n_frames": None, "lr": 1e-3, "evaluation": False}
    rows = {"on_policy_minibatch_size": frames // 16, "on_policy_n_minibatch_iters": 4}
    turns = {"on_policy_collected_frames_per_batch": frames, "on_policy_n_envs_per_worker": worlds}
    config = replace(stock, save_folder=out, loggers=["csv"], create_json=False, **length, **rows, **turns)
    experiment = Experiment(task, IppoConfig.get_from_yaml(), MlpConfig.get_from_yaml(), seed, config)
    experiment.run()
    return experiment.mean_return


if __name__ == "__main__":
    print(tyro.cli(main))
