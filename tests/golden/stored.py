"""What stored runs do in fresh worlds: evaluated, mixed, among named backgrounds, and where they go.

python tests/golden/stored.py KIND ... FOLDER      writes what these kinds of evaluation gave to found.json
"""

import json
import sys
from itertools import pairwise
from pathlib import Path

from golden import OWN_ALGORITHMS, RESULTS, WITH_THE_FAULT, checksum, columns

import cprl
from cprl.measuring.table import all_metrics, complete, where

TEN_TARGETS = "commons_targets_10"
cprl.trust(*OWN_ALGORITHMS)


def runs() -> dict[str, Path]:
    """The stored runs that keep weights and whose game can be played, by their path below docs/results.

    stored.json also holds four runs whose weights left docs/results after commit c9708fc0: `git checkout
    c9708fc0 -- docs/results` brings them back, and then they are played again.
    """
    found = sorted(path.parents[1] for path in RESULTS.rglob("checkpoints/*.pt"))
    by_path = {path.relative_to(RESULTS).as_posix(): path for path in found}
    return {path: run for path, run in by_path.items() if run / "recipe.json" not in WITH_THE_FAULT}


def twice() -> cprl.Fresh:
    """An episode of each of two replicas."""
    return cprl.Fresh(episodes=1, replicas=(0, 1))


def evaluated() -> dict[str, object]:
    found = {}
    for name, path in runs().items():
        for greedy in (False, True):
            played = cprl.evaluate_run(path, cprl.Fresh(episodes=1, greedy=greedy))
            label = f"{name}{', greedy' * greedy}"
            found[label] = columns(played)
            trained = where(played, policy="trained")
            agents = range(len(trained["agent"].unique()))
            numbers = [*all_metrics(trained), *(f"agent_{agent}/return" for agent in agents)]
            found[f"{label}, estimates"] = {
                metric: [estimate.value, estimate.low, estimate.high]
                for (metric,), estimate in cprl.estimates(trained, numbers).items()
                if estimate.replicas
            }
    return found


def crossed() -> dict[str, object]:
    """Cross-play of neighbours among the six ways of `swap_the_loss`, and of two runs of `commons`."""
    names = [name for name in runs() if name.startswith("swap_the_loss")]
    pairs = [*pairwise(names), ("commons", TEN_TARGETS)]
    played = {
        f"{one}, {other}": cprl.crossplay([RESULTS / one, RESULTS / other], twice()) for one, other in pairs
    }
    return {name: columns(table) for name, table in played.items()}


def schelling() -> dict[str, object]:
    from cprl import presets
    from cprl.experimental.schelling import schelling

    boards = {board: presets.game(board, variant="as_run") for board in ("two_complex", "commons")}
    return {board: columns(schelling(game, twice())) for board, game in boards.items()}


def scenarios() -> dict[str, object]:
    from cprl.evaluation import run_scenarios

    return {
        name: columns(run_scenarios(RESULTS / name, twice()))
        for name in ("two_complex", "commons", "swap_the_loss/ppo")
    }


def territory() -> dict[str, object]:
    import cprl
    from cprl.experimental.territory import TERRITORY_NUMBERS, maps_of, territory_of
    from cprl.measuring.table import where

    names = {"visits": "visits", "taggings": "tags_by_agent", "tagged_where": "tags_by_cell"}
    found = {}
    for name in ("commons", "two_complex"):
        table = territory_of(RESULTS / name, cprl.Fresh(episodes=1, replicas=(0, 1)))
        board = cprl.load(RESULTS / name).game.map
        for policy in ("trained", "random"):
            rows = where(table, policy=policy, agent=0).sort_by("replica")
            numbers = {words: rows[number].to_pylist() for number, words in TERRITORY_NUMBERS.items()}
            arrays = {key: maps_of(table, column, policy) for key, column in names.items()}
            for key in ("visits", "tagged_where"):
                arrays[key] = arrays[key].reshape(*arrays[key].shape[:2], board.height, board.width)
            sums = {key: checksum(array) for key, array in arrays.items()}
            found[f"{name}, {policy}"] = {**sums, **numbers}
    return found


def responses() -> dict[str, object]:
    """The episodes of the best responses that were trained against stored runs."""
    import pyarrow.parquet as pq

    tables = sorted((RESULTS / "exploitability").glob("*.parquet"))
    return {path.stem: columns(complete(pq.read_table(path))) for path in tables}


KINDS = {kind.__name__: kind for kind in (evaluated, crossed, schelling, scenarios, territory, responses)}

if __name__ == "__main__":
    *kinds, folder = sys.argv[1:]
    found = {f"{kind}: {name}": case for kind in kinds for name, case in KINDS[kind]().items()}
    Path(folder, "found.json").write_text(json.dumps(found))
