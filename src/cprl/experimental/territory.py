"""territory_of: where the agents of a stored run go in fresh worlds and whom they tag, beside random play."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes

from cprl.commons.cells import APPLE, GROUND, WALL
from cprl.commons.maps import Map
from cprl.evaluation.evaluate import opened
from cprl.evaluation.lanes import (
    agents_of,
    commons_game,
    fresh_for,
    policies_of,
    said,
    scripted,
    together,
    worlds_of,
)
from cprl.evaluation.pages import heading
from cprl.experimental import movement
from cprl.experimental.movement import Array, Trace, overlap, owners, trace, visits
from cprl.measuring.statistics import estimates
from cprl.measuring.table import labelled, where
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.terminal import style
from cprl.terminal.tables import Cells
from cprl.training.stored import LoadedRun
from cprl.values import checked, refusal

Policy = Literal["trained", "random"]

WORDS: Final[Mapping[str, str]] = {
    "exclusion": "exclusion (0 to 1)",
    "visitors": "agents that share a cell",
    "overlap": "overlap of two agents within an episode (0 to 1)",
    "tag_rate": "tags per 1000 steps",
    "defence": "tags in one's own territory (0 to 1)",
}
"""What the numbers of a table of territory are called: exclusion, visitors and defence of the visits of all
episodes of a replica, overlap the mean over episodes; NaN where undefined."""
ARRAYS: Final = ("visits", "tags_by_agent", "tags_by_cell")
"""Its arrays of each agent, as lists: float64 [H x W], the share of its time in each cell, mean over
episodes; int64 [N], how often it was tagged by each, and [H x W], in each cell, in all episodes."""


@working("evaluating")
def territory_of(run: str | Path | LoadedRun, fresh: Fresh = Fresh()) -> pa.Table:
    """Let every replica of a stored run play fresh episodes, and random agents in the same worlds.

    The episodes are those of `cprl.evaluate_run` with the same arguments.

    Returns:
        A row for each policy, replica and agent, by "policy": "trained" or "random"; with the numbers of
        `WORDS` and `ARRAYS`, see `maps_of`.
    """
    loaded = opened(run)
    commons_game(loaded)
    fresh = fresh_for([loaded], fresh)
    policies = {"trained": agents_of(loaded), "random": [scripted("random")] * loaded.game.agents}
    parts: list[pa.Table] = []
    for policy, agents in policies.items():
        for group, env in worlds_of(fresh, loaded):
            played = trace(env, policies_of(fresh, loaded, agents, group), explore=not fresh.greedy)
            for place, replica in enumerate(group):
                first = place * fresh.episodes
                rows = _of_replica(played.worlds(first, first + fresh.episodes))
                labels = {"policy": policy, "replica": replica}
                parts.append(labelled(pa.table(rows), **labels))
    return together(
        parts,
        heading=heading(loaded.path.name, fresh, [loaded]),
        weights=loaded.weights_from,
        run=loaded.path.name,
        episodes=fresh.episodes,
    )


def _of_replica(played: Trace) -> dict[str, Any]:
    """Return the columns of the worlds of one replica, an entry for each agent."""
    shares = visits(played).mean(0)  # every agent is in play as an episode begins
    taggings = movement.taggings(played)
    tags = taggings.sum((1, 2))
    driven_out = np.where(tags > 0, movement.defence(played, shares), 0.0)
    with np.errstate(invalid="ignore"):
        defence = (driven_out * tags).sum() / np.float64(tags.sum())
    numbers = {
        "exclusion": movement.exclusion(shares),
        "visitors": movement.visitors(shares),
        "overlap": overlap(played).mean(),
        "tag_rate": 1000 * tags.sum() / played.played.sum(),
        "defence": defence,
    }
    arrays = (shares, taggings.sum(0), movement.tagged_where(played).sum(0))
    agents = len(shares)
    return {
        "agent": list(range(agents)),
        **{name: np.full(agents, value) for name, value in numbers.items()},
        **{name: list(array.reshape(agents, -1)) for name, array in zip(ARRAYS, arrays, strict=True)},
    }


def maps_of(table: pa.Table, name: str, policy: Policy = "trained") -> Array:
    """Return one of `ARRAYS` of all replicas, [R, N, H x W] or [R, N, N]."""
    rows = where(table, policy=checked("policy", policy, Policy)).sort_by("replica")
    arrays = np.array(rows[name].to_pylist())
    return arrays.reshape(len(rows["replica"].unique()), -1, arrays.shape[-1])


def number_of(table: pa.Table, name: str, policy: Policy = "trained") -> Array:
    """Return one of the numbers of `WORDS` of all replicas, float64 [R]."""
    rows = where(table, policy=checked("policy", policy, Policy), agent=0).sort_by("replica")
    return np.array(rows[name].to_pylist(), np.float64)


def territory_cells(table: pa.Table) -> Cells:
    """Return a row for each number: mean over replicas and 95 % interval, of the run's agents and of random
    ones; a dash where it is undefined in all."""
    means = estimates(table, list(WORDS), "policy")
    rows = []
    for name, words in WORDS.items():
        of_policies = [means[policy, name] for policy in ("trained", "random")]
        rows.append([words, *(one if one.replicas else "-" for one in of_policies)])
    return Cells("where agents go, and whom they tag", ["", "run's agents", "random"], rows)


COLUMNS: Final = 3
"""Maps side by side."""
DARKEST: Final = 0.3
"""The brightness of a cell that was visited least; 1 is the cell with the longest stay."""


def draw_visits(
    table: pa.Table,
    board: Map,
    path: str | Path,
    *,
    replica: int | None = None,
    policy: Policy = "trained",
    width: style.Width = "page",
) -> Path:
    """Draw who spends most time in each cell, and where each agent of a replica spends its time.

    Hue is the agent. Brightness is the share of its time by its square root, the same scale in all maps, from
    the least to the longest stay of any agent. A ring is where the agent starts, small squares are sites, and
    grey cells walls. In the first map a cell has the hue of its owner; it is brighter the more time the owner
    spends there, and the larger its share in the time of all. As agents have four hues, numbers say who owns
    what, each where its owner spends most time.

    Args:
        table: of `territory_of`.
        board: the map of the run's game.
        replica: the index of the replica in the run; by default the first one that played.
    """
    replicas = sorted(table["replica"].unique().to_pylist())
    number = replicas[0] if replica is None else replica
    if number not in replicas:
        raise refusal("replica", number, f"one that played, of {replicas}")
    rows = where(table, replica=number)
    shares = maps_of(rows, "visits", policy).reshape(-1, board.height, board.width)
    tagged = maps_of(rows, "tags_by_agent", policy)[0].sum(1)
    owner = owners(shares)
    longest = shares.max(0)
    total = shares.sum(0)
    hues = np.stack([_rgb(agent_colour(agent)) for agent in range(len(shares))])
    alone = np.divide(longest, total, out=np.zeros_like(total), where=total > 0)
    light = DARKEST + (1 - DARKEST) * np.sqrt(longest / max(longest.max(), 1e-12)) * alone
    with style.drawing(path, width=width, colours=style.SHADES, is_new=True) as sheet:
        columns = sheet.fitting(min(COLUMNS, len(shares) + 1), 16)
        high = sheet.width_em / columns * board.height / board.width + 2
        whole, *panels = sheet.panels(len(shares) + 1, columns=columns, high=high)
        _show(whole, board, hues[owner], np.where(owner >= 0, light, 0.0), "who spends most time where")
        for agent, panel in enumerate(panels):
            title = f"agent {agent}, tagged {tagged[agent]:,} times"
            _show(panel, board, hues[agent], _light(shares[agent], shares.max()), title)
            row, col, _ = board.starts[agent]
            panel.plot(col, row, "o", markersize=5, fillstyle="none", color="white", markeredgewidth=0.8)
            owned = np.where(owner == agent, shares[agent], 0.0)
            if owned.any():
                row, col = divmod(int(owned.argmax()), board.width)
                look: Any = {"color": "white", "ha": "center", "va": "center_baseline"}
                whole.text(col, row, str(agent), **look)
        first = where(rows, policy=policy, agent=0)
        exclusion, sharing = (first[name][0].as_py() for name in ("exclusion", "visitors"))
        sheet.title = f"Where {'random ' * (policy == 'random')}agents spend their time"
        sheet.caption = (
            f"{said(table, 'run')}, replica {number}, {said(table, 'episodes')} episodes; exclusion "
            f"{exclusion:.2f}, {sharing:.1f} agents share a cell. The brighter, the longer; a ring is where "
            "an agent starts, squares are sites of apples, grey cells walls."
        )
    return Path(path)


def _show(panel: Axes, board: Map, hues: Array, light: Array, title: str) -> None:
    """Show hues [H, W, 3] on the ground by their brightness [H, W], with the board's walls and sites."""
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
    """Return the brightness of cells, 0..1, by the square root of the share of an agent's time."""
    return np.where(shares > 0, DARKEST + (1 - DARKEST) * np.sqrt(shares / max(longest, 1e-12)), 0.0)


def _rgb(colour: tuple[int, int, int]) -> Array:
    return np.array(colour) / 255
