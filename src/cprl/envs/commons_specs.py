"""What CommonsEnv takes and gives, as specs of TorchRL."""

from typing import Any, NamedTuple

import torch
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from cprl import keys
from cprl.commons.game import Game
from cprl.institutions import COUNTS
from cprl.system.compat import flag_spec

WORLD_ENTRIES = ("stock", "regrown")
DONE_ENTRIES = ("done", "terminated", "truncated")


class Specs(NamedTuple):
    """The specs of B worlds of a game, each of batch size [B]."""

    action: Composite
    observation: Composite
    reward: Composite
    done: Composite


def specs_of(game: Game, worlds: int, *, state: bool) -> Specs:
    """Those of so many worlds; with `state` observations have the whole board."""
    per_agent = worlds, game.agents

    def group(**specs: Any) -> Composite:
        return Composite(agents=Composite(**specs, shape=per_agent), shape=(worlds,))

    decision = {"decision": Categorical(game.decisions, shape=per_agent, dtype=torch.int64)}
    action = group(
        action=Categorical(len(game.actions), shape=per_agent, dtype=torch.int64),
        **(decision if game.decisions else {}),
    )
    observation = group(
        observation=Bounded(
            0, game.observation_highest, shape=(*per_agent, *game.observation_shape), dtype=torch.uint8
        ),
        harvest=Bounded(0, 1, shape=per_agent, dtype=torch.float32),
        in_play=flag_spec(*per_agent),
        fired=flag_spec(*per_agent),
        hit_by=flag_spec(*per_agent, game.agents),
        tagged_by=flag_spec(*per_agent, game.agents),
    )
    if game.observation.scoreboard:
        most, shape = float(game.rules.episode_steps), (*per_agent, game.agents)
        observation[keys.SCOREBOARD] = Bounded(0, most, shape=shape, dtype=torch.float32)
    if game.observation.stock_gauge:
        observation[keys.STOCK_GAUGE] = Bounded(0, 1, shape=(*per_agent, 1), dtype=torch.float32)
    if game.institutions:
        _add_institutions(observation, game, per_agent)
    for name in WORLD_ENTRIES:
        observation[name] = Bounded(0, len(game.map.sites), shape=(worlds, 1), dtype=torch.int64)
    if state:
        board = worlds, 3, game.map.height, game.map.width
        observation[keys.STATE] = Bounded(0, 255, shape=board, dtype=torch.uint8)
    return Specs(
        action=action,
        observation=observation,
        reward=group(reward=Unbounded(shape=(*per_agent, 1), dtype=torch.float32)),
        done=Composite({name: flag_spec(worlds, 1) for name in DONE_ENTRIES}, shape=(worlds,)),
    )


def _add_institutions(specs: Composite, game: Game, per_agent: tuple[int, int]) -> None:
    for key in (keys.FINES, keys.TRANSFERS):
        specs[key] = Unbounded(shape=per_agent, dtype=torch.float32)
    specs[keys.VIOLATED] = flag_spec(*per_agent)
    specs[keys.COUNTS] = Unbounded(shape=(*per_agent, len(COUNTS)), dtype=torch.int32)
    if game.ballots:
        of_ballots = per_agent[0], len(game.ballots)
        specs[keys.IN_FORCE] = Unbounded(shape=of_ballots, dtype=torch.float32)
        specs[keys.BALLOTS_DUE] = flag_spec(*of_ballots)
