"""What lies under the transforms of an environment, and what its specs say of the agents."""

from torchrl.envs import EnvBase, TransformedEnv

from cprl import keys
from cprl.envs.commons_env import CommonsEnv


def base_env(env: EnvBase) -> EnvBase:
    """Return the environment without its transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def commons_of(env: EnvBase) -> CommonsEnv | None:
    """Return the `CommonsEnv` under its transforms; None for a game of another kind."""
    base = base_env(env)
    return base if isinstance(base, CommonsEnv) else None


def clock_of(env: EnvBase) -> int | None:
    """Return the turns of an episode at most; None where a game does not say."""
    return clock_in(getattr(base_env(env), "game", None))


def clock_in(game: object) -> int | None:
    """Return the turns of an episode of a game at most; None where it does not say."""
    return getattr(getattr(game, "rules", None), "episode_steps", None)


def agent_count(env: EnvBase) -> int:
    """Return the number of agents N of an environment of batch size [B]."""
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
    """Return the names of the agents: those of the environment's group "agents", else agent_0 and so on."""
    named = getattr(base_env(env), "group_map", None)
    if isinstance(named, dict) and keys.AGENTS in named:
        return tuple(named[keys.AGENTS])
    return tuple(f"agent_{agent}" for agent in range(agent_count(env)))


def action_count(env: EnvBase) -> int:
    """Return the number of actions A of each agent."""
    return int(env.full_action_spec[keys.ACTION].n)


def joint_actions(env: EnvBase) -> tuple[str, ...]:
    """Return the names of the joint actions, as the environment's `joint_actions` says; () where it has none.

    Raises:
        ValueError: if there is not one name for each of the A**N joint actions.
    """
    named = getattr(base_env(env), "joint_actions", ())
    names = tuple(named) if isinstance(named, tuple | list) else ()
    if names and len(names) != action_count(env) ** agent_count(env):
        raise ValueError(
            f"joint_actions of the environment has {len(names)} names; allowed: one for each of "
            f"{action_count(env)} ** {agent_count(env)} joint actions"
        )
    return names
