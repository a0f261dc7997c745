"""Where do independent learners end, between the Nash equilibrium and the group's optimum?

    nice python recipes/study/theory/where_learners_end.py --out docs/results/theory        a few core minutes

Trains the conditions of `CONDITIONS`, one after the other, writes what all agents took and gained, in the
mean of each five episodes, to `taken.parquet`, and draws `taken.png`; what is there already is not trained
again. `--draw` draws and prints the table alone.

What was expected, written down before the first run:
- Individual rewards: the group ends near X* of the equilibrium, and not at the optimum, the farther from it
  the more agents there are. A few percent below X* are possible: agents that learn by trial against others
  who do the same are known to end a little below it in such games (Waltman and Kaymak, "Q-learning agents in
  a Cournot oligopoly model", 2008).
- The reward of the team: each is paid what all gain, which depends on the total alone, so every way to share
  X** is an equilibrium of that game; the group ends near X**, with more spread, since nobody can tell what
  its own action did among eight.
- Nobody ends at open access.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from matplotlib.axes import Axes
from sharing import TURNS, experiment, sharing_of
from sharing_games import SharingGame
from taking_games import TakingGame
from tensordict import TensorDictBase

import cprl
from cprl import keys
from cprl.measuring.statistics import estimate
from cprl.measuring.table import where
from cprl.terminal.style import MARK_COLOUR, MEAN_COLOUR, RAW_COLOUR, drawing
from cprl.values.array_types import Float64

GAMES: Final = (("herders", 2), ("herders", 5), ("appropriation", 8))
WAYS: Final = {("tables", "team"): 150, ("PPO", "individual"): 150, ("tables", "individual"): 300}
"""The ways in which agents learn and are paid, with the number of episodes: tables with individual rewards
settle long after exploration has ended."""
LABELS: Final = ("game", "agents", "learner", "reward")
CONDITIONS: Final = [dict(zip(LABELS, (*game, *way), strict=True)) for way in WAYS for game in GAMES]
BLOCK: Final = 5
"""The episodes of a row."""
LAST: Final = 0.2
"""The share of the training, at its end, that the table is about."""
COLOURS: Final = {"individual": MEAN_COLOUR, "team": "#238b45"}
DASHES: Final = {"tables": "-", "PPO": (0, (4, 1.5))}

Condition = Mapping[str, Any]


class Taken:
    """A callback that notes what all agents take and gain in each turn of each replica."""

    def __init__(self, game: TakingGame) -> None:
        self.amounts = np.array(game.amounts)
        self.payments = game.agents * game.sharing.payment
        self.totals: list[Any] = []
        self.gains: list[Any] = []

    def on_step(self, batch: TensorDictBase) -> None:
        """See `cprl.training.training.Callback`."""
        self.totals.append(self.amounts[batch[keys.AGENTS, "action"].numpy()].sum(-1))
        reward = batch["next", keys.AGENTS, "reward"].double().numpy()
        self.gains.append(reward.sum((1, 2)) - self.payments)


def block_means(turns: list[Any]) -> Float64:
    """Return means of each `BLOCK` episodes, float64 [blocks, R]."""
    size = BLOCK * TURNS
    blocks = len(turns) // size
    return np.reshape(turns[: blocks * size], (blocks, size, -1)).mean(1)


def train(condition: Condition) -> pa.Table:
    """Train a condition; return a row for each block of episodes of each replica."""
    kind, herd, learner, reward = condition.values()
    trained = experiment(kind=kind, herd=herd, learner=learner, wants=reward)
    trained = replace(trained, episodes=WAYS[learner, reward])
    taken = Taken(trained.game)
    with TemporaryDirectory() as folder:
        quiet: dict[str, Any] = {"watch": "off", "figures": False, "keep_checkpoint": False}
        cprl.run(trained, Path(folder) / "run", callbacks=[taken], **quiet)
    totals = block_means(taken.totals)
    block, replica = np.indices(totals.shape)
    columns = {
        "replica": replica.ravel(),
        "episode": BLOCK * block.ravel(),
        "total": totals.ravel().astype(np.float32),
        "gain": block_means(taken.gains).ravel().astype(np.float32),
    }
    labels = {name: [value] * totals.size for name, value in condition.items()}
    return pa.table(labels | columns)


def curves_of(table: pa.Table, condition: Condition) -> dict[str, Float64]:
    """Return the episodes, totals and gains of a condition, [blocks, R] each; nothing where it is not
    there."""
    rows = where(table, **condition)
    if not len(rows):
        return {}
    replicas = len(rows["replica"].unique())
    return {name: rows[name].to_numpy().reshape(-1, replicas) for name in ("episode", "total", "gain")}


def draw(table: pa.Table, path: Path) -> None:
    """Draw the total taken over the training, a panel for each game, with what theory says."""
    with drawing(path) as sheet:
        panels = dict(zip(GAMES, sheet.panels(len(GAMES), row_height_em=24, sharex=True), strict=True))
        for (kind, herd), panel in panels.items():
            panel.set(title=f"{kind}, {herd} agents", ylabel="taken a turn, in all")
            _draw_theory(panel, sharing_of(kind, herd))
        for condition in CONDITIONS:
            kind, herd, learner, reward = condition.values()
            curves = curves_of(table, condition)
            if curves:
                look: Any = {"color": COLOURS[reward], "linestyle": DASHES[learner]}
                at = curves["episode"][:, 0] + BLOCK / 2
                panel = panels[kind, herd]
                panel.plot(at, curves["total"], **look, linewidth=0.5, alpha=0.35)
                label = f"{learner}, {reward} reward"
                panel.plot(at, curves["total"].mean(1), **look, linewidth=2, label=label)
        panel.set_xlabel(f"episode of {TURNS} turns")
        sheet.title = "Independent learners and what theory expects"
        sheet.caption = (
            "Thick: the mean of 8 replicas, thin: each; means of five episodes, exploration included."
        )


def _draw_theory(panel: Axes, sharing: SharingGame) -> None:
    totals = {
        "open access": (sharing.open_access_total, RAW_COLOUR, ":"),
        "equilibrium": (sharing.nash_total, MARK_COLOUR, "--"),
        "optimum": (sharing.optimum_total, "black", "-."),
    }
    for name, (total, color, linestyle) in totals.items():
        panel.axhline(total, linewidth=1.3, color=color, linestyle=linestyle)
        panel.text(1.0, total, f" {name}", transform=panel.get_yaxis_transform(), va="center", color=color)
    panel.set_ylim(0, 1.12 * sharing.open_access_total)


def print_table(table: pa.Table) -> None:
    """Print a line of Markdown for each condition: what is taken and gained at the end of the training."""
    print("| game | agents | learner | reward | taken | equilibrium | optimum | gain, % of the best |")
    print("|---|---:|---|---|---:|---:|---:|---:|")
    for condition in CONDITIONS:
        curves = curves_of(table, condition)
        if curves:
            sharing = sharing_of(condition["game"], condition["agents"])
            end = -round(LAST * len(curves["episode"]))
            taken = estimate(curves["total"][end:].mean(0))
            gain = estimate(100 * curves["gain"][end:].mean(0) / sharing.surplus(sharing.optimum_total))
            numbers = f"{taken:.4g} | {sharing.nash_total:.4g} | {sharing.optimum_total:.4g} | {gain:.4g}"
            print(f"| {' | '.join(map(str, condition.values()))} | {numbers} |")


def main(
    *, out: Path = Path("docs/results/theory"), draw_only: Annotated[bool, tyro.conf.arg(name="draw")] = False
) -> None:
    """Train what is missing, draw, and print the table.

    Args:
        out: the folder of results.
        draw_only: draw and print what is there, train nothing.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / "taken.parquet"
    parts = [pq.read_table(path)] if path.exists() else []
    for condition in [] if draw_only else CONDITIONS:
        if not any(curves_of(part, condition) for part in parts):
            parts.append(train(condition))
            pq.write_table(pa.concat_tables(parts), path)
    if not parts:
        raise SystemExit(f"{path} is not there; train first, without --draw")
    table = pa.concat_tables(parts)
    draw(table, out / "taken.png")
    print_table(table)


if __name__ == "__main__":
    tyro.cli(main)
