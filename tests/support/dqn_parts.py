"""Learners of plain DQN, and its loss over one network, for tests of learners and engines."""

from dataclasses import fields

import numpy as np
import torch
from c51 import C51
from cql import CQL
from iql import IQL
from tensordict import TensorDict

from cprl import Game, Rules, algorithms, maps
from cprl.algorithms import DQN, DQNSettings, OffPolicy, OnPolicy
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.plain import PlainNetworks
from cprl.learners.ring import Ring
from cprl.learners.transitions import LaneTurn, randomized
from cprl.objectives.functional import weights_of

MEADOW = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=12, freeze_steps=2),
)
"""A small board for two agents."""
KINDS = [
    kind
    for kind in map(vars(algorithms).get, algorithms.__all__)
    if issubclass(kind, OffPolicy | OnPolicy) and kind not in (OffPolicy, OnPolicy)
] + [C51, CQL, IQL]
"""All algorithms that a `Learner` learns by, those of the examples included."""


def make_learner(algorithm, spaces, *, engine="compiled", **lanes):
    return algorithm.make_learner(Lanes(spaces, **lanes), engine)


def changed(algorithm, **methods):
    """An algorithm of a subclass that has other methods, or says another `update`."""
    kind = type(algorithm)
    named = {name: staticmethod(value) if callable(value) else value for name, value in methods.items()}
    own = type(kind.__name__, (kind,), named)
    return own(**{field.name: getattr(algorithm, field.name) for field in fields(algorithm)})


def dqn_learner(spaces, *, settings, make_loss=None, update=None, engine="compiled", **lanes):
    methods = {} if make_loss is None else {"make_loss": make_loss}
    methods |= {} if update is None else {"update": update}
    algorithm = changed(DQN(settings=settings), **methods) if methods else DQN(settings=settings)
    return make_learner(algorithm, spaces, engine=engine, **lanes)


def dqn_loss(network, *, gamma):
    return DQN(settings=DQNSettings(gamma=gamma)).make_loss(network)


def played(learner, env, steps, seen=None):
    """The losses of a learner of all agents after each step in an environment, None without an update; the
    turns are added to `seen`."""
    moment, losses = env.reset(), []
    for _ in range(steps):
        moment["agents", "action"] = learner.actor.choose(moment["agents", "observation"])
        turn, moment = env.step_and_maybe_reset(moment)
        learner.store(turn)
        losses.append(learner.update())
        if turn["next", "done"].any():
            learner.end_episode(turn["next", "done"].flatten())
        if seen is not None:
            seen.append(turn)
    return losses


def transitions(observation, action, next_observation, reward, ends, **entries):
    """Transitions under TorchRL's default keys, of tensors or lists; `ends` are "done" and "terminated"."""
    after = {"observation": next_observation, "reward": reward, "done": ends, "terminated": ends}
    before = {"observation": observation, "action": action, **entries}
    size = [len(action)]
    made, made_after = (
        TensorDict({name: torch.as_tensor(entry) for name, entry in entries.items()}, size)
        for entries in (before, after)
    )
    return made.set("next", made_after)


def learn(learner, batch):
    """The losses of one step of a learner's networks by a batch, [L, b]."""
    return learner.lane_networks.learn(Draw.of(batch))


def watch_steps(learner, seen):
    """Adds what `seen` gives of each batch that a learner learns from to a list, which it returns."""
    found, step = [], learner.lane_networks.learn

    def watched(draw):
        found.append(seen(draw))
        return step(draw)

    learner.lane_networks.learn = watched
    return found


def weights_at(networks, place):
    """The weights of a network and its targets, by their names in the loss."""
    if isinstance(networks, PlainNetworks):
        return weights_of(networks.losses[place])
    return {name: value[place] for name, value in {**networks.params, **networks.targets}.items()}


def made_up_batch(form, lanes, actions):
    """Transitions [L, 8] of such a form, always the same; one in eight ends an episode."""
    ring = Ring(
        form, seeds=[(lane,) for lane in range(lanes)], transitions=8 + form.steps_ahead, batch_size=8
    )
    batch = randomized(ring.get(torch.arange(8).expand(lanes, -1)), actions)
    for name in ("done", "terminated"):
        batch["next", name][:, -1] = True
    return batch


def write(ring, transitions):
    """Writes a transition of every lane, [L], under TorchRL's default keys."""
    after = transitions["next"]
    flags = (after[name].flatten().numpy() for name in ("done", "terminated"))
    before = (transitions[name].numpy() for name in ("observation", "action"))
    ring.write(LaneTurn(*before, after["observation"].numpy(), after["reward"].squeeze(-1).numpy(), *flags))


def q_table(learner, lane):
    """The table of a lane of a tabular learner, a row a state it has met: the bytes of all that it observed,
    the window, and of each action its value and its visits."""
    states, values, visits = learner.lane_networks.tables.lane_table(lane)
    spaces = learner.lanes.spaces
    size = np.prod(spaces.observation_shape) * np.dtype(spaces.observation_dtype).itemsize
    seen = np.ascontiguousarray(states[:, :size]).view(spaces.observation_dtype)
    seen = seen.reshape(len(states), *spaces.observation_shape)
    return {
        "state": [state.tobytes() for state in states],
        "observation": seen,
        "values": values,
        "visits": visits,
    }
