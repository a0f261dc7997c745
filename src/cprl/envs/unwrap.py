"""What lies under the transforms of an environment, and what its specs say of the agents."""

from torchrl.envs import EnvBase, TransformedEnv

from cprl import keys
from cprl.envs.commons_env import CommonsEnv


def base_env(env: EnvBase) -> EnvBase:
    """The environment without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def commons_of(env: EnvBase) -> CommonsEnv | None:
    """The `CommonsEnv` under its transforms; None for a game of another kind."""
    base = base_env(env)
    return base if isinstance(base, CommonsEnv) else None


def clock_of(env: EnvBase) -> int | None:
    """Return the turns of an episode at most; None where a game does not say."""
    return clock_in(getattr(base_env(env), "game", None))


def clock_in(game: object) -> int | None:
    """Return the turns of an episode of a game at most; None where it does not say."""
    return getattr(getattr(game, "rules", None), "episode_steps", None)


def agent_count(env: EnvBase) -> int:
    """The number of agents N of an environment of batch size [B]."""
    size = tuple(env.batch_size)
    if len(size) != 1:
        raise ValueError(f"the environment has batch size {list(size)}; allowed: [B], B worlds")
    reward = env.full_reward_spec.get(keys.REWARD, None)
    shape = None if reward is None else tuple(reward.shape)
    if shape is None or len(shape) != 3 or shape[::2] != (*size, 1):
        came = None if shape is None else list(shape)
        raise ValueError(f'("agents", "reward") is {came}; allowed: [{size[0]}, N, 1]')
    return int(shape[1])


def agent_names(env: EnvBase) -> tuple[str, ...]:
    """The names of the agents: those of the environment's group "agents", else agent_0 and so on."""
    named = getattr(base_env(env), "group_map", None)
    if isinstance(named, dict) and keys.AGENTS in named:
        return tuple(named[keys.AGENTS])
    return tuple(f"agent_{agent}" for agent in range(agent_count(env)))
