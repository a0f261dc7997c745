"""A ring of transitions whose numbers say where they come from."""

import numpy as np
import torch
from dqn_parts import write
from tensordict import TensorDict

from cprl.learners.ring import Ring
from cprl.learners.transitions import TransitionForm

SHAPE, ACTIONS = (3, 4, 5), 6


def transition(lane, step):
    """What a lane sees, by its number and the step alone; episodes end at times of its own."""
    chance = np.random.default_rng([lane, step])
    done = step % (5 + lane) == 4

    def window(*place):
        return torch.from_numpy(np.random.default_rng([lane, *place]).integers(0, 256, SHAPE, np.uint8))

    return {
        "observation": window(step, 1),
        "action": torch.tensor(int(chance.integers(ACTIONS))),
        "next": {
            "observation": window(step + 1, 2 if done else 1),
            "reward": torch.tensor([float(chance.random() < 0.3)]),
            "done": torch.tensor([done]),
            "terminated": torch.tensor([done and lane % 2 == 0]),
        },
    }


def row(lanes, step):
    return torch.stack([TensorDict(transition(lane, step)).auto_batch_size_(0) for lane in lanes])


def filled(lanes, *, steps=60, transitions=40, batch_size=4, horizon=None):
    form = TransitionForm(observation_shape=SHAPE, horizon=horizon)
    seeds = [(7, lane) for lane in lanes]
    ring = Ring(form, seeds=seeds, transitions=transitions, batch_size=batch_size)
    for step in range(steps):
        write(ring, row(lanes, step))
    return ring
