"""Build environments: `make_env` makes that of any game, adds transforms and checks the result.

Games of the user's own are described by `PlayableGame`, and turned into values that a recipe can hold.
"""

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
from cprl.envs.env_state import env_state, load_env_state
from cprl.values import Custom, Seed, checked, custom_of, instantiate, refusal


@runtime_checkable
class PlayableGame(Protocol):
    """A game that an experiment can play, as a frozen value; `cprl.Game` is one.

    A recipe stores a game of the user's own by the name of its class, which must be defined at the top of a
    module, and by the arguments that `to_config` returns.

    `make` returns an environment of batch size [B], the number of worlds. Its entries are
    ("agents", "observation") [B, N, ...], ("agents", "action") int64 [B, N], ("agents", "reward") float32
    [B, N, 1], and at the root done, terminated and truncated, each bool [B, 1]. Its `state_dict` holds
    everything that decides how it goes on, apart from the TensorDict that it is stepped with.

    The environment may have two more attributes. `group_map` names the agents, as a list under "agents".
    `joint_actions` names the A**N joint actions, with the action of agent 0 first, e.g. ("CC", "CD", "DC",
    "DD"). The viewer then plots their shares, for up to 16 joint actions.
    """

    @property
    def agents(self) -> int:
        """Return the number of agents N."""

    def to_config(self) -> Mapping[str, Any]:
        """Return the arguments that build the game again, as values of JSON.

        The game is then built with tuples in place of the lists, nested ones too.
        """

    def make(self, worlds: int, seed: int, device: Any) -> Any:
        """Return an `EnvBase` of several worlds side by side, whose random numbers follow from the seed.

        A game may take a further argument `first_world`, the index of the first world, from 0. World b of a
        batch must then play the same as the only world of a batch with `first_world=b`. For a game without
        this argument, a batch that begins with world b is made with the seed `seed + b`.

        Args:
            worlds: the number of worlds B.
            seed: the seed of all random numbers.
            device: the device of the worlds and of all their tensors.
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
    """Make an environment of a game, with transforms, and check that experiments can play it.

    Args:
        game: the game to play, or a `Custom` that makes it.
        worlds: the number of worlds B, the batch size of the environment.
        seed: the seed of all random numbers.
        device: the device of the worlds and of all their tensors.
        first_world: the index of the first world, with which a world plays the same in batches of any size;
            `PlayableGame.make` says what happens with games that do not take it.
        transforms: TorchRL transforms, the first one next to the game; each may be a `Custom` that makes it.

    Raises:
        ValueError: if the game or its environment lacks something that `PlayableGame` requires.
    """
    playable: Any = instantiate(game)
    if not isinstance(playable, PlayableGame) or isinstance(playable, type):
        raise refusal("game", playable, "a cprl.Game, or a game with agents, to_config and make")
    make: Any = playable.make
    env: EnvBase
    if "first_world" in signature(make).parameters:
        env = make(worlds, seed, device, first_world=first_world)
    else:
        env = make(worlds, checked("seed + first_world", seed + first_world, Seed), device)
    transform_chain = [instantiate(transform) for transform in transforms]
    if transform_chain:
        env = TransformedEnv(env, Compose(*transform_chain))
    check_env(env, worlds)
    return env


def spaces_of(env: EnvBase) -> Spaces:
    """Return the observation and action spaces of the agents, as they are after all transforms.

    Raises:
        ValueError: if either is missing, or has another form than `PlayableGame` says.
    """
    observation_spec = _agents_spec(env, "observation")
    action_spec = _agents_spec(env, "action")
    if not isinstance(action_spec, Categorical) or action_spec.ndim != 2:
        raise ValueError(
            f'("agents", "action") has the spec {type(action_spec).__name__} {list(action_spec.shape)} of '
            f"{action_spec.dtype}; allowed: Categorical [worlds, agents]"
        )
    worlds, agents = action_spec.shape[:2]
    if observation_spec.shape[:2] != action_spec.shape[:2]:
        raise ValueError(
            f'("agents", "observation") is {list(observation_spec.shape)}; allowed: [{worlds}, {agents}, ...]'
        )
    # Some transforms change observations and not their spec, so shape and dtype are read from a real one.
    observation = _first_observation(env) if isinstance(env, TransformedEnv) else observation_spec
    scale = 1.0
    if isinstance(observation_spec, Bounded) and not observation.dtype.is_floating_point:
        scale = float(observation_spec.high.max())
    return Spaces(
        agents=agents,
        observation_shape=tuple(observation.shape[2:]),
        observation_dtype=str(observation.dtype).removeprefix("torch."),
        observation_scale=scale,
        actions=int(action_spec.n),
        talk=bool(getattr(env, "talk", False)),
    )


def _first_observation(env: EnvBase) -> Tensor:
    """Return ("agents", "observation") of a reset, and restore the environment as it was before it."""
    with torch.random.fork_rng(devices=[]):
        state = deepcopy(env_state(env))
        observation: Tensor = env.reset().get(keys.OBSERVATION)
        load_env_state(env, state)
    return observation


def check_env(env: EnvBase, worlds: int) -> None:
    """Raise a ValueError, which says what is allowed, for an environment that trainings could not play.

    `worlds`: the batch size that the environment must have.
    """
    if tuple(env.batch_size) != (worlds,):
        raise ValueError(f"the environment has batch size {list(env.batch_size)}; allowed: [{worlds}]")
    spaces = spaces_of(env)
    reward_spec = env.full_reward_spec.get(keys.REWARD, None)
    _check_shape('("agents", "reward")', reward_spec, [worlds, spaces.agents, 1])
    for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED):
        _check_shape(f'"{name}" at the root', env.full_done_spec.get(name, None), [worlds, 1])


def _check_shape(name: str, spec: Any, allowed_shape: list[int]) -> None:
    """Refuse an entry whose spec has another shape, or that has no spec."""
    shape = None if spec is None else list(spec.shape)
    if shape != allowed_shape:
        raise ValueError(f"{name} is {shape}; allowed: {allowed_shape}")


def _agents_spec(env: EnvBase, name: str) -> Any:
    """Return the spec of the entry "observation" or "action" under "agents"."""
    composite = env.full_action_spec if name == "action" else env.observation_spec
    spec = composite.get((keys.AGENTS, name), None)
    if spec is None:
        raise ValueError(f'("agents", "{name}") is missing in the environment; allowed: games that have it')
    return spec


def stored_game(game: object) -> object:
    """Return the value that a recipe stores for a game.

    This is a `Custom` with class and arguments for a game of the user's own, and any other value itself.
    """
    if isinstance(game, Game | Custom) or not isinstance(game, PlayableGame):
        return game
    stored: Custom = custom_of(type(game))
    return replace(stored, arguments=game.to_config())


def game_of(stored: Custom) -> Custom | PlayableGame:
    """Return the game that `stored_game` stored as a `Custom`.

    A `Custom` that does not stand for a game's class and arguments, such as one with a function that makes a
    game, is returned itself.

    Raises:
        ValueError: if the class does not take the arguments.
    """
    game_class = stored.resolve()
    is_game_class = isinstance(game_class, type) and hasattr(game_class, "to_config")
    if not (is_game_class and hasattr(game_class, "make")):
        return stored
    try:
        game = game_class(**{name: _nested_tuples(value) for name, value in stored.arguments.items()})
    except (TypeError, ValueError) as error:
        raise ValueError(f"experiment.game: {stored.target} does not take its arguments: {error}") from error
    return game if isinstance(game, PlayableGame) and stored_game(game) == stored else stored


def _nested_tuples(value: Any) -> Any:
    """Return a value with tuples in place of lists, nested ones too: [[1, 2], 3] becomes ((1, 2), 3)."""
    return tuple(map(_nested_tuples, value)) if isinstance(value, list) else value


def is_playable(value: Any) -> bool:
    """Return whether a value is a game, of cprl or of the user's own, or a `Custom` that makes one."""
    return isinstance(value, Game | Custom | PlayableGame) and not isinstance(value, type)
