"""Where do independent learners end, between the Nash equilibrium and the group's optimum?

    nice python recipes/study/theory/where_learners_end.py --out docs/results/theory        a few core minutes

Trains the conditions of `CONDITIONS`, one after the other, writes what all agents took and gained, in the
mean of each five episodes, to `taken.parquet`, and draws `taken.png`; what is there already is not trained
again.
`--draw` draws and prints the table alone.

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

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from numpy.typing import NDArray
from sharing import TURNS, experiment, sharing_of
from sharing_games import SharingGame
from taking_games import TakingGame
from tensordict import TensorDictBase

import cprl
from cprl import keys
from cprl.measuring.statistics import estimate
from cprl.terminal.style import MARK, MEAN, RAW, drawing

GAMES: Final = (("herders", 2), ("herders", 5), ("appropriation", 8))
WAYS: Final = {("tables", "team"): 150, ("PPO", "individual"): 150, ("tables", "individual"): 300}
"""How agents learn and what they are paid, with the number of episodes: tables with individual rewards settle
long after exploration has ended."""
CONDITIONS: Final = [(*game, *way) for way in WAYS for game in GAMES]
BLOCK: Final = 5
"""Episodes of a row."""
LAST: Final = 0.2
"""The share of the training, at its end, that the table is about."""
COLOURS: Final = {"individual": MEAN, "team": "#238b45"}
DASHES: Final = {"tables": "-", "PPO": (0, (4, 1.5))}


class Taken:
    """A callback: what all agents take and gain in each turn of each replica."""

    def __init__(self, game: TakingGame) -> None:
        self.amounts, self.payments = np.array(game.amounts), game.agents * game.sharing.payment
        self.totals: list[Any] = []
        self.gains: list[Any] = []

    def on_step(self, batch: TensorDictBase) -> None:
        """See `cprl.training.training.Callback`."""
        self.totals.append(self.amounts[batch.get((keys.AGENTS, "action")).numpy()].sum(-1))
        paid = batch.get(("next", keys.AGENTS, "reward")).double().numpy()
        self.gains.append(paid.sum((1, 2)) - self.payments)

    def blocks(self, turns: list[Any]) -> NDArray[np.float64]:
        """Means of each `BLOCK` episodes, float64 [blocks, R]."""
        size = BLOCK * TURNS
        whole = len(turns) // size
        return np.reshape(turns[: whole * size], (whole, size, -1)).mean(1)


def measured(kind: Any, herd: int, learner: Any, wants: Any) -> pa.Table:
    """Trains a condition; a row for each block of episodes of each replica."""
    own = experiment(kind=kind, herd=herd, learner=learner, wants=wants)
    own = replace(own, episodes=WAYS[learner, wants])
    taken = Taken(own.game)
    with TemporaryDirectory() as folder:
        how: dict[str, Any] = {"watch": "off", "figures": False, "keep_checkpoint": False}
        cprl.run(own, Path(folder) / "run", callbacks=[taken], **how)
    totals, gains = taken.blocks(taken.totals), taken.blocks(taken.gains)
    block, replica = np.indices(totals.shape)
    columns = {
        **dict(zip(("game", "agents", "learner", "reward"), (kind, herd, learner, wants), strict=True)),
        "replica": replica.ravel(),
        "episode": BLOCK * block.ravel(),
        "total": totals.ravel().astype(np.float32),
        "gain": gains.ravel().astype(np.float32),
    }
    rows = totals.size
    return pa.table({name: own if np.ndim(own) else [own] * rows for name, own in columns.items()})


def of_condition(table: pa.Table, condition: tuple[Any, ...]) -> dict[str, NDArray[Any]]:
    """Episodes [blocks], and totals and gains [blocks, R], of a condition; empty where it is not there."""
    found = [row for row in table.to_pylist() if condition == tuple(row[own] for own in _NAMES)]
    if not found:
        return {}
    replicas = 1 + max(row["replica"] for row in found)
    columns = {name: np.array([row[name] for row in found]) for name in ("episode", "total", "gain")}
    shaped = {name: own.reshape(-1, replicas) for name, own in columns.items()}
    return {**shaped, "episode": shaped["episode"][:, 0]}


_NAMES: Final = ("game", "agents", "learner", "reward")


def draw(table: pa.Table, path: Path) -> None:
    """Total taken over the training, a panel for each game, with what theory says."""
    with drawing(path) as sheet:
        panels = sheet.panels(len(GAMES), high=24, sharex=True)
        for panel, (kind, herd) in zip(panels, GAMES, strict=True):
            sharing = sharing_of(kind, herd)
            _draw_theory(panel, sharing)
            for learner, wants in WAYS:
                found = of_condition(table, (kind, herd, learner, wants))
                if found:
                    look: Any = {"color": COLOURS[wants], "linestyle": DASHES[learner]}
                    at = found["episode"] + BLOCK / 2
                    panel.plot(at, found["total"], **look, linewidth=0.5, alpha=0.35)
                    label = f"{learner}, {wants} reward"
                    panel.plot(at, found["total"].mean(1), **look, linewidth=2, label=label)
            panel.set(title=f"{kind}, {herd} agents", ylabel="taken a turn, in all")
            panel.set_ylim(0, 1.12 * sharing.open_access_total)
        panels[-1].set_xlabel(f"episode of {TURNS} turns")
        sheet.title = "Independent learners and what theory expects"
        sheet.caption = (
            "Thick: the mean of 8 replicas, thin: each; means of five episodes, exploration included."
        )


def _draw_theory(panel: Axes, sharing: SharingGame) -> None:
    lines = {
        "open access": (sharing.open_access_total, {"color": RAW, "linestyle": ":"}),
        "equilibrium": (sharing.nash_total, {"color": MARK, "linestyle": "--"}),
        "optimum": (sharing.optimum_total, {"color": "black", "linestyle": "-."}),
    }
    for name, (total, look) in lines.items():
        panel.axhline(total, linewidth=1.3, **look)
        at = {"x": 1.0, "y": total, "transform": panel.get_yaxis_transform()}
        panel.text(**at, s=f" {name}", va="center", color=look["color"])


def print_table(table: pa.Table) -> None:
    """A line of Markdown for each condition: what is taken and gained at the end of the training."""
    print("| game | agents | learner | reward | taken | equilibrium | optimum | gain, % of the best |")
    print("|---|---:|---|---|---:|---:|---:|---:|")
    for condition in CONDITIONS:
        found = of_condition(table, condition)
        if found:
            sharing = sharing_of(condition[0], condition[1])
            end = -round(LAST * len(found["episode"]))
            taken = estimate(found["total"][end:].mean(0))
            share = 100 * found["gain"][end:].mean(0) / sharing.surplus(sharing.optimum_total)
            theory = f"{sharing.nash_total:.4g} | {sharing.optimum_total:.4g}"
            cells = " | ".join(map(str, condition))
            print(f"| {cells} | {taken:.4g} | {theory} | {estimate(share):.4g} |")


def main() -> None:
    """Trains what is missing, draws, and prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/results/theory"), help="the folder of results")
    parser.add_argument("--draw", action="store_true", help="draw and print what is there, train nothing")
    how = parser.parse_args()
    how.out.mkdir(parents=True, exist_ok=True)
    path = how.out / "taken.parquet"
    table = pq.read_table(path) if path.exists() else None
    for condition in [] if how.draw else CONDITIONS:
        if table is None or not of_condition(table, condition):
            new = measured(*condition)
            table = new if table is None else pa.concat_tables([table, new])
            pq.write_table(table, path)
    if table is None:
        raise SystemExit(f"{path} is not there; train first, without --draw")
    draw(table, how.out / "taken.png")
    print_table(table)


if __name__ == "__main__":
    main()
