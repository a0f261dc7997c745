"""make_env, the one place where an environment is put together, and games of the user's own in recipes."""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical
from torchrl.envs import Compose, EnvBase, TransformedEnv

from cprl import keys
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.state import env_state, load_env_state
from cprl.values import Custom, Seed, checked, custom_of, made, refusal


@runtime_checkable
class PlayableGame(Protocol):
    """What an experiment can play: a frozen value; `cprl.Game` is one.

    A recipe holds a game of the user's own by the name of its class, which stands at the top of a module.

    The environment that it makes has batch size [worlds], ("agents", "observation") [B, N, ...],
    ("agents", "action") int64 [B, N], ("agents", "reward") float32 [B, N, 1], and done, terminated and
    truncated bool [B, 1] at the root. Whatever its future depends on, besides the TensorDict that it is
    stepped with, is in its `state_dict`.

    The environment may have two more attributes. `group_map` names the agents, as a list in its group
    "agents". `joint_actions` names the A**N joint actions, the action of agent 0 first, e.g. ("CC", "CD",
    "DC", "DD"); the viewer then plots their shares, of at most 16.
    """

    @property
    def agents(self) -> int:
        """The number of agents N."""

    def to_config(self) -> Mapping[str, Any]:
        """Return the arguments that build it again, as JSON can hold them; lists are given back as tuples."""

    def make(self, worlds: int, seed: int, device: Any) -> Any:
        """Return an `EnvBase` of so many worlds side by side, whose chance follows from the seed.

        A game may take a further argument `first_world`, the number of the first world, from 0: world b of a
        batch then plays as the only world of a batch with `first_world=b`. Without it, a batch that begins
        with world b is made with the seed `seed + b`.
        """


def make_env(
    game: PlayableGame | Custom,
    *,
    worlds: int = 1,
    seed: int = 0,
    device: str | torch.device = "cpu",
    first_world: int = 0,
    transforms: Iterable[Any] = (),
) -> EnvBase:
    """Return an environment of a game, with transforms.

    Args:
        game: what is played, or a `Custom` that makes it.
        seed: of all chance.
        first_world: the number of the first world, so that a world plays the same in batches of any size; see
            `PlayableGame.make` for games that do not take it.
        transforms: TorchRL transforms, or a `Custom` for each.
    """
    playable: Any = made(game)
    if not isinstance(playable, PlayableGame) or isinstance(playable, type):
        raise refusal("game", playable, "a cprl.Game, or a game with agents, to_config and make")
    make: Any = playable.make
    env: EnvBase
    if "first_world" in signature(make).parameters:
        env = make(worlds, seed, device, first_world=first_world)
    else:
        env = make(worlds, checked("seed + first_world", seed + first_world, Seed), device)
    chain = [made(transform) for transform in transforms]
    if chain:
        env = TransformedEnv(env, Compose(*chain))
    check_env(env, worlds)
    return env


def spaces_of(env: EnvBase) -> Spaces:
    """Return what each agent of an environment observes and may do, transforms included."""
    observation, action = _spec(env, "observation"), _spec(env, "action")
    if not isinstance(action, Categorical) or action.ndim != 2:
        raise ValueError(
            f'("agents", "action") has the spec {type(action).__name__} {list(action.shape)} of '
            f"{action.dtype}; allowed: Categorical [worlds, agents]"
        )
    worlds, agents = action.shape[:2]
    if observation.shape[:2] != action.shape[:2]:
        raise ValueError(
            f'("agents", "observation") is {list(observation.shape)}; allowed: [{worlds}, {agents}, ...]'
        )
    shape, dtype = observation.shape, observation.dtype
    if isinstance(env, TransformedEnv):  # some transforms change observations and not their spec
        seen = _first_observation(env)
        shape, dtype = seen.shape, seen.dtype
    is_float = dtype.is_floating_point
    highest = float(observation.high.max()) if isinstance(observation, Bounded) and not is_float else 1.0
    return Spaces(
        agents=agents,
        observation_shape=tuple(shape[2:]),
        observation_dtype=str(dtype).removeprefix("torch."),
        observation_scale=highest,
        actions=int(action.n),
    )


def _first_observation(env: EnvBase) -> Tensor:
    """("agents", "observation") after a reset, of which the environment keeps nothing."""
    with torch.random.fork_rng(devices=[]):
        before = deepcopy(env_state(env))
        seen: Tensor = env.reset().get(keys.OBSERVATION)
        load_env_state(env, before)
    return seen


def check_env(env: EnvBase, worlds: int) -> None:
    """Raise a ValueError, with what is allowed, for an environment that a training could not play."""
    if tuple(env.batch_size) != (worlds,):
        raise ValueError(f"the environment has batch size {list(env.batch_size)}; allowed: [{worlds}]")
    spaces = spaces_of(env)
    reward = env.full_reward_spec.get(keys.REWARD, None)
    _check_shape('("agents", "reward")', reward, [worlds, spaces.agents, 1])
    for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED):
        _check_shape(f'"{name}" at the root', env.full_done_spec.get(name, None), [worlds, 1])


def _check_shape(name: str, spec: Any, allowed: list[int]) -> None:
    shape = None if spec is None else list(spec.shape)
    if shape != allowed:
        raise ValueError(f"{name} is {shape}; allowed: {allowed}")


def _spec(env: EnvBase, name: str) -> Any:
    group = env.full_action_spec if name == "action" else env.observation_spec
    spec = group.get((keys.AGENTS, name), None)
    if spec is None:
        raise ValueError(f'("agents", "{name}") is missing in the environment; allowed: games that have it')
    return spec


def stored_game(game: object) -> object:
    """Return a game as a recipe holds it: one of the user's own by its class, and what it is made from."""
    if isinstance(game, Game | Custom) or not isinstance(game, PlayableGame):
        return game
    stored: Custom = custom_of(type(game))
    return replace(stored, arguments=game.to_config())


def game_of(stored: Custom) -> Custom | PlayableGame:
    """Return the game whose class and arguments these are; the same where they only make one."""
    kind = stored.resolve()
    if not (isinstance(kind, type) and hasattr(kind, "to_config") and hasattr(kind, "make")):
        return stored
    try:
        game = kind(**{name: _nested_tuples(value) for name, value in stored.arguments.items()})
    except (TypeError, ValueError) as error:
        raise ValueError(f"experiment.game: {stored.target} does not take its arguments: {error}") from error
    return game if isinstance(game, PlayableGame) and stored_game(game) == stored else stored


def _nested_tuples(value: Any) -> Any:
    """Return lists in lists as tuples in tuples."""
    return tuple(map(_nested_tuples, value)) if isinstance(value, list) else value


def is_playable(value: Any) -> bool:
    """Return whether it is a game, of cprl or of the user's own, or the `Custom` that makes one."""
    return isinstance(value, Game | Custom | PlayableGame) and not isinstance(value, type)
