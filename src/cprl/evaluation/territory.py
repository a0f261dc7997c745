"""territory_of: where the agents of a stored run go in fresh worlds and whom they tag, beside random play."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes

from cprl.commons.colours import APPLE, GROUND, PALETTE, WALL, agent_colour
from cprl.commons.maps import Map
from cprl.evaluation.evaluate import BESIDE_RANDOM, SEED, heading, opened
from cprl.evaluation.lanes import Agent, Fresh, agents_of, commons_game, fresh_of, scripted
from cprl.measuring import movement
from cprl.measuring.movement import Array, Trace, overlap, owners, trace, visits
from cprl.measuring.statistics import Estimate, estimate
from cprl.system.working import working
from cprl.terminal import style
from cprl.terminal.tables import Cells
from cprl.training.agents import LoadedRun
from cprl.values import checked, refusal

Policy = Literal["trained", "random"]

EXCLUSION: Final = "exclusion (0 to 1)"
VISITORS: Final = "agents that share a cell"
OVERLAP: Final = "overlap of two agents within an episode (0 to 1)"
TAGS: Final = "tags per 1000 steps"
DEFENCE: Final = "tags in one's own territory (0 to 1)"


@dataclass(frozen=True, kw_only=True, eq=False)
class Stays:
    """Where agents were and whom they tagged, by replica."""

    visits: Array
    """float64 [R, N, H, W], the share of its time of each agent in each cell, mean over episodes."""
    taggings: Array
    """int64 [R, N, N], how often the agent of the row was tagged by that of the column, in all episodes."""
    tagged_where: Array
    """int64 [R, N, H, W], how often each agent was tagged in each cell, in all episodes."""
    by_replica: dict[str, Array]
    """float64 [R] each: exclusion, agents that share a cell and tags in one's own territory, of the visits of
    all episodes; overlap, mean over episodes; tags per 1000 steps. NaN where a measure is undefined."""

    def measures(self) -> dict[str, Estimate]:
        """The mean over the replicas in which each measure is defined, if there are any, and its interval."""
        defined = {name: values[np.isfinite(values)] for name, values in self.by_replica.items()}
        return {name: estimate(values) for name, values in defined.items() if len(values)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Territory:
    """Where a run's agents go in fresh worlds, and where random ones go in the same worlds."""

    run: LoadedRun
    fresh: Fresh
    """Of R replicas, as in the arrays of `Stays`."""
    trained: Stays = field(repr=False)
    random: Stays = field(repr=False)

    def of(self, policy: Policy) -> Stays:
        stays: Stays = getattr(self, checked("policy", policy, Policy))
        return stays


@working("evaluating")
def territory_of(
    run: str | Path | LoadedRun,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
) -> Territory:
    """Plays fresh episodes with every replica of a stored run, and with random agents in the same worlds.

    The episodes are those of `cprl.evaluate_run` with the same arguments.
    """
    loaded = opened(run)
    commons_game(loaded)
    fresh = fresh_of([loaded], episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    random = [scripted("random")] * loaded.game.agents
    return Territory(
        run=loaded,
        fresh=fresh,
        trained=_stays(loaded, agents_of(loaded), fresh),
        random=_stays(loaded, random, fresh),
    )


def _stays(run: LoadedRun, agents: Sequence[Agent], fresh: Fresh) -> Stays:
    by_replica: list[dict[str, Any]] = []
    for group, env in fresh.worlds(run):
        played = trace(env, fresh.policies(run, agents, group), explore=not fresh.greedy)
        firsts = range(0, len(group) * fresh.episodes, fresh.episodes)
        by_replica += [_of_replica(played.worlds(first, first + fresh.episodes)) for first in firsts]
    stacked = {name: np.stack([arrays[name] for arrays in by_replica]) for name in by_replica[0]}
    arrays = {name: stacked.pop(name) for name in ("visits", "taggings", "tagged_where")}
    return Stays(**arrays, by_replica=stacked)


def _of_replica(played: Trace) -> dict[str, Any]:
    """The arrays and measures of the worlds of one replica."""
    shares = visits(played).mean(0)  # every agent is in play as an episode begins
    taggings = movement.taggings(played)
    tags = taggings.sum((1, 2))
    driven_out = np.where(tags > 0, movement.defence(played, shares), 0.0)
    with np.errstate(invalid="ignore"):
        defence = (driven_out * tags).sum() / np.float64(tags.sum())
    return {
        "visits": shares,
        "taggings": taggings.sum(0),
        "tagged_where": movement.tagged_where(played).sum(0),
        EXCLUSION: movement.exclusion(shares),
        VISITORS: movement.visitors(shares),
        OVERLAP: overlap(played).mean(),
        TAGS: 1000 * tags.sum() / played.played.sum(),
        DEFENCE: defence,
    }


COLUMNS: Final = 3
"""Maps side by side."""
DARKEST: Final = 0.3
"""The brightness of a cell that was visited least; 1 is the cell with the longest stay."""


def draw_visits(
    territory: Territory,
    path: str | Path,
    *,
    replica: int | None = None,
    policy: Policy = "trained",
    width: style.Width = "page",
) -> Path:
    """Draws who spends most time in each cell, and where each agent of a replica spends its time.

    Hue is the agent. Brightness is the share of its time by its square root, the same scale in all maps, from
    the least to the longest stay of any agent. A ring is where the agent starts, small squares are sites, and
    grey cells walls. In the first map a cell has the hue of its owner; it is brighter the more time the owner
    spends there, and the larger its share in the time of all. As agents have four hues, numbers say who owns
    what, each where its owner spends most time.

    Args:
        replica: the index of the replica in the run; by default the first one that played.
    """
    stays, replicas = territory.of(policy), territory.fresh.replicas
    number = replicas[0] if replica is None else replica
    if number not in replicas:
        raise refusal("replica", number, f"one that played, of {list(replicas)}")
    place = replicas.index(number)
    board, shares = territory.run.game.map, stays.visits[place]
    owner, longest, total = owners(shares), shares.max(0), shares.sum(0)
    hues = np.stack([_rgb(agent_colour(agent)) for agent in range(len(shares))])
    alone = np.divide(longest, total, out=np.zeros_like(total), where=total > 0)
    light = DARKEST + (1 - DARKEST) * np.sqrt(longest / max(longest.max(), 1e-12)) * alone
    with style.drawing(path, width=width, colours=style.SHADES, is_new=True) as sheet:
        columns = sheet.fitting(min(COLUMNS, len(shares) + 1), 16)
        high = sheet.width_em / columns * board.height / board.width + 2
        whole, *panels = sheet.panels(len(shares) + 1, columns=columns, high=high)
        _show(whole, board, hues[owner], np.where(owner >= 0, light, 0.0), "who spends most time where")
        for agent, panel in enumerate(panels):
            title = f"agent {agent}, tagged {int(stays.taggings[place, agent].sum()):,} times"
            _show(panel, board, hues[agent], _light(shares[agent], shares.max()), title)
            row, col, _ = board.starts[agent]
            panel.plot(col, row, "o", markersize=5, fillstyle="none", color="white", markeredgewidth=0.8)
            owned = np.where(owner == agent, shares[agent], 0.0)
            if owned.any():
                row, col = divmod(int(owned.argmax()), board.width)
                look: Any = {"color": "white", "ha": "center", "va": "center_baseline"}
                whole.text(col, row, str(agent), **look)
        index, sharing = (float(stays.by_replica[name][place]) for name in (EXCLUSION, VISITORS))
        sheet.title = f"Where {'random ' if policy == 'random' else ''}agents spend their time"
        sheet.caption = (
            f"{territory.run.path.name}, replica {number}, {territory.fresh.episodes} episodes; exclusion "
            f"{index:.2f}, {sharing:.1f} agents share a cell. The brighter, the longer; a ring is where an "
            "agent starts, squares are sites of apples, grey cells walls."
        )
    return Path(path)


def _show(panel: Axes, board: Map, hues: Array, light: Array, title: str) -> None:
    """Shows hues [H, W, 3] on the ground by their brightness [H, W], with the board's walls and sites."""
    image = _rgb(PALETTE[GROUND]) * (1 - light[..., None]) + hues * light[..., None]
    for cell in board.walls:
        image[cell] = _rgb(PALETTE[WALL])
    panel.imshow(image, interpolation="nearest")
    rows, cols = np.array(board.sites).T
    panel.scatter(cols, rows, s=1.5, marker="s", color=_rgb(PALETTE[APPLE]), linewidths=0)
    panel.set(xticks=[], yticks=[])
    panel.spines[:].set_visible(False)
    panel.set_title(title)


def _light(shares: Array, longest: float) -> Array:
    """The brightness of cells, 0..1, by the square root of the share of an agent's time."""
    return np.where(shares > 0, DARKEST + (1 - DARKEST) * np.sqrt(shares / max(longest, 1e-12)), 0.0)


def _rgb(colour: tuple[int, int, int]) -> Array:
    return np.array(colour) / 255


def territory_table(territory: Territory) -> Cells:
    """A row for each measure of territory: mean over replicas and 95 % interval, of the run's agents and of
    random ones; a dash where it is undefined in all."""
    trained, random = territory.trained.measures(), territory.random.measures()
    rows = [
        (name, *(str(of_policy.get(name, "-")) for of_policy in (trained, random)))
        for name in territory.trained.by_replica
    ]
    title = heading(territory.run.path.name, territory.fresh, [territory.run])
    return Cells(title, BESIDE_RANDOM, rows)
