"""territory_of: measure whether the agents of a stored run keep to places of their own, and whom they tag.

The agents play fresh worlds, and random agents play the same worlds for comparison.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from numpy.typing import NDArray

from cprl.commons.cells import APPLE, GROUND, WALL
from cprl.commons.maps import Map
from cprl.evaluation.pages import heading
from cprl.evaluation.populations import (
    agents_of,
    commons_game,
    fresh_for,
    fresh_worlds,
    join_tables,
    policies_of,
    scripted_agent,
    table_note,
)
from cprl.experimental import movement
from cprl.experimental.movement import Trace, overlap, owners, trace, visit_shares
from cprl.measuring.statistics import estimates
from cprl.measuring.table import labelled, where
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.terminal import picture_files, style
from cprl.terminal.text_tables import TextTable
from cprl.training.stored import LoadedRun, as_loaded
from cprl.values import checked, refusal
from cprl.values.array_types import Float64

PlayedPolicy = Literal["trained", "random"]

TERRITORY_NUMBERS: Final[Mapping[str, str]] = {
    "exclusion": "exclusion (0 to 1)",
    "visitors": "agents that share a cell",
    "overlap": "overlap of two agents within an episode (0 to 1)",
    "tag_rate": "tags per 1000 steps",
    "defence": "tags in one's own territory (0 to 1)",
}
"""The numbers of a table of territory, with what they are called: exclusion, visitors and defence of the
visits of all episodes of a replica, overlap the mean over episodes; NaN where undefined."""
ARRAY_COLUMNS: Final = {
    "visits": "float64 [H x W], the share of its time that the agent spent in each cell, mean over episodes",
    "tags_by_agent": "int64 [N], how often each agent tagged it, in all episodes",
    "tags_by_cell": "int64 [H x W], how often it was tagged in each cell, in all episodes",
}
"""The columns of a table of territory that hold a list for each agent, and what they hold."""


@working("evaluating")
def territory_of(run: str | Path | LoadedRun, fresh: Fresh = Fresh()) -> pa.Table:
    """Play fresh episodes with all replicas of a run, and with random agents in the same worlds.

    The episodes are those of `cprl.evaluate_run` with the same arguments.

    Returns:
        A row for each policy, replica and agent, by "policy": "trained" or "random"; with the numbers of
        `TERRITORY_NUMBERS` and `ARRAY_COLUMNS`, see `maps_of`.
    """
    loaded = as_loaded(run)
    commons_game(loaded)
    fresh = fresh_for([loaded], fresh)
    policies = {"trained": agents_of(loaded), "random": [scripted_agent("random")] * loaded.game.agents}
    parts: list[pa.Table] = []
    for policy, agents in policies.items():
        for group, env in fresh_worlds(fresh, loaded):
            played = trace(env, policies_of(fresh, loaded, agents, group), explore=not fresh.greedy)
            for place, replica in enumerate(group):
                first = place * fresh.episodes
                rows = _columns_of_replica(played.worlds(first, first + fresh.episodes))
                labels = {"policy": policy, "replica": replica}
                parts.append(labelled(pa.table(rows), **labels))
    return join_tables(
        parts,
        heading=heading(loaded.path.name, fresh, [loaded]),
        weights=loaded.weights_from,
        run=loaded.path.name,
        episodes=fresh.episodes,
    )


def _columns_of_replica(played: Trace) -> dict[str, Any]:
    """Return the columns of a replica, with an entry for each agent."""
    shares = visit_shares(played).mean(0)  # every agent is in play as an episode begins
    taggings = movement.taggings(played)
    tags = taggings.sum((1, 2))
    driven_out = np.where(tags > 0, movement.defence(played, shares), 0.0)
    with np.errstate(invalid="ignore"):
        defence = (driven_out * tags).sum() / np.float64(tags.sum())
    numbers = {
        "exclusion": movement.exclusion(shares),
        "visitors": movement.agents_per_cell(shares),
        "overlap": overlap(played).mean(),
        "tag_rate": 1000 * tags.sum() / played.played.sum(),
        "defence": defence,
    }
    arrays = (shares, taggings.sum(0), movement.tagged_where(played).sum(0))
    agents = len(shares)
    return {
        "agent": list(range(agents)),
        **{name: np.full(agents, value) for name, value in numbers.items()},
        **{name: list(array.reshape(agents, -1)) for name, array in zip(ARRAY_COLUMNS, arrays, strict=True)},
    }


def maps_of(table: pa.Table, name: str, policy: PlayedPolicy = "trained") -> NDArray[Any]:
    """Return one of `ARRAY_COLUMNS` of all replicas, [R, N, H x W] or [R, N, N]."""
    rows = where(table, policy=checked("policy", policy, PlayedPolicy)).sort_by("replica")
    arrays = np.array(rows[name].to_pylist())
    return arrays.reshape(len(rows["replica"].unique()), -1, arrays.shape[-1])


def number_of(table: pa.Table, name: str, policy: PlayedPolicy = "trained") -> Float64:
    """Return one of the numbers of `TERRITORY_NUMBERS` of all replicas, float64 [R]."""
    rows = where(table, policy=checked("policy", policy, PlayedPolicy), agent=0).sort_by("replica")
    return np.array(rows[name].to_pylist(), np.float64)


def territory_table(table: pa.Table) -> TextTable:
    """Return a table of the numbers, for the run's agents and for random ones: means with 95 % intervals."""
    means = estimates(table, list(TERRITORY_NUMBERS), "policy")
    rows = []
    for name, text in TERRITORY_NUMBERS.items():
        numbers = [means[policy, name] for policy in ("trained", "random")]
        rows.append([text, *(number if number.replicas else "-" for number in numbers)])
    return TextTable("where agents go, and whom they tag", ["", "run's agents", "random"], rows)


_COLUMNS: Final = 3
"""The largest number of maps side by side."""
DARKEST: Final = 0.3
"""The brightness of a cell that was visited least; 1 is the cell with the longest stay."""


def draw_visits(
    table: pa.Table,
    board: Map,
    path: str | Path,
    *,
    replica: int | None = None,
    policy: PlayedPolicy = "trained",
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
    with style.drawing(path, width=width, colours=picture_files.PNG_SHADES, refuse_existing=True) as sheet:
        columns = sheet.columns_that_fit(min(_COLUMNS, len(shares) + 1), 16)
        high = sheet.width_em / columns * board.height / board.width + 2
        whole, *panels = sheet.panels(len(shares) + 1, columns=columns, row_height_em=high)
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
            f"{table_note(table, 'run')}, replica {number}, {table_note(table, 'episodes')} episodes; "
            f"exclusion {exclusion:.2f}, {sharing:.1f} agents share a cell. The brighter, the longer; a ring "
            "is where an agent starts, squares are sites of apples, grey cells walls."
        )
    return Path(path)


def _show(panel: Axes, board: Map, hues: Float64, light: Float64, title: str) -> None:
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


def _light(shares: Float64, longest: float) -> Float64:
    """Return the brightness of cells, 0..1, by the square root of the share of an agent's time."""
    return np.where(shares > 0, DARKEST + (1 - DARKEST) * np.sqrt(shares / max(longest, 1e-12)), 0.0)


def _rgb(colour: tuple[int, int, int]) -> Float64:
    return np.array(colour) / 255
