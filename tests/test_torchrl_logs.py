"""TorchRL's own trainer and recorder, which know nothing of cprl, log through its Logger interface."""

import gymnasium
import numpy as np
import pytest
import torch
from recordings import column
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, TransformedEnv
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss
from torchrl.record import VideoRecorder
from torchrl.trainers import LogScalar, LogValidationReward, Trainer

from cprl.viewer.logger import RerunLogger

FRAMES = 60


class Corridor(gymnasium.Env):
    """Five cells; a step to the right pays its cell's number. The camera shows one white pixel."""

    action_space = gymnasium.spaces.Discrete(2)
    observation_space = gymnasium.spaces.Dict(
        {
            "place": gymnasium.spaces.Box(0, 1, (5,), np.float32),
            "pixels": gymnasium.spaces.Box(0, 255, (2, 5, 3), np.uint8),
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.steps = 0
        return self.seen(), {}

    def step(self, action):
        self.at, self.steps = int(np.clip(self.at + (1 if action else -1), 0, 4)), self.steps + 1
        return self.seen(), float(self.at), False, self.steps == 6, {}

    def seen(self):
        pixels = np.zeros((2, 5, 3), np.uint8)
        pixels[0, self.at] = 255
        return {"place": np.eye(5, dtype=np.float32)[self.at], "pixels": pixels}


def torchrl_example(logger):
    """A DQN agent by TorchRL's `Trainer`, watched by TorchRL's hooks; what it collected is returned."""
    value = TensorDictModule(torch.nn.Linear(5, 2), in_keys=["place"], out_keys=["action_value"])
    greedy = TensorDictSequential(value, QValueModule(action_space="categorical"))

    def corridor():
        return GymWrapper(Corridor(), categorical_action_encoding=True)

    explore = EGreedyModule(corridor().action_spec, eps_init=0.5, eps_end=0.5)
    trainer = Trainer(
        collector=Collector(
            corridor(),
            TensorDictSequential(greedy, explore),
            frames_per_batch=12,
            total_frames=FRAMES,
            auto_register_policy_transforms=False,
        ),
        total_frames=FRAMES,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=DQNLoss(greedy, action_space="categorical", delay_value=False),
        optimizer=torch.optim.Adam(value.parameters()),
        logger=logger,
        log_interval=1,
        progress_bar=False,
    )
    rewards = []
    camera = VideoRecorder(logger, tag="corridor", in_keys=["pixels"], skip=1, make_grid=False)
    trainer.register_op("batch_process", lambda batch: rewards.append(batch["next", "reward"].mean().item()))
    LogScalar(("next", "reward"), logname="r_training").register(trainer)
    LogValidationReward(
        record_interval=2,
        record_frames=6,
        policy_exploration=greedy,
        environment=TransformedEnv(corridor(), camera),
    ).register(trainer)
    trainer.train()
    return rewards


# TorchRL 0.14.1's Trainer warns of the hooks that it registers itself.
@pytest.mark.filterwarnings("ignore:The .* hook stage will be replaced:FutureWarning")
def test_a_torchrl_example_that_knows_nothing_of_cprl_is_recorded(tmp_path):
    with RerunLogger("corridor", tmp_path) as logger:
        rewards = torchrl_example(logger)
    path = tmp_path / "run.rrd"
    steps, logged = column(path, "r_training", "Scalars:scalars")
    assert steps == [12, 24, 36, 48, 60]
    assert [value[0] for value in logged] == pytest.approx(rewards)
    steps, losses = column(path, "loss", "Scalars:scalars")
    assert steps == [12, 24, 36, 48, 60]
    assert all(loss[0] > 0 for loss in losses)
    steps, evaluated = column(path, "r_evaluation", "Scalars:scalars")
    assert steps == [12, 36, 60], "in every second batch"
    steps, images = column(path, "corridor", "Image:buffer")
    assert steps == list(range(21)), "the recorder counts clips of seven images, which follow each other"
    pictures = np.array(images, np.uint8).reshape(3, 7, 2, 5, 3)
    assert (pictures.max(-1).sum((2, 3), dtype=int) == 255).all(), "one white pixel in each"
    places = pictures[..., 0, :, 0].argmax(-1)
    assert places[:, 0].tolist() == [0, 0, 0]
    filmed = places[:, 1:].mean(1), np.array(evaluated)[:, 0]
    assert filmed[0] == pytest.approx(filmed[1]), "the film shows what was paid: the cell's number"
