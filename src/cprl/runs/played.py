"""Runs of people: episodes that were played and not trained, as a finished run."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import pyarrow as pa

from cprl.measuring.table import where
from cprl.measuring.tracker import Episode
from cprl.runs.episodes import FILE_NAME, read_table, table_of, write_small
from cprl.runs.files import REPORT, refuse_to_write_over, time_now, write_json, write_listed
from cprl.runs.recipe import read_recipe
from cprl.runs.weights import save_weights

TURNS: Final = "turns.parquet"
"""The file with a row for each turn, group and agent of a hosted run. Its columns "turn", from 1, "group",
"agent", "action" and, in games with ballots, "decision", where a governor decided "rule", are enough to
replay it; "person", in runs that have it, says whether a person was there to act."""


def write_played(run: Path, episodes: Sequence[Episode], **tables: pa.Table) -> None:
    """Finish a run whose episodes were played by people: write its tables, and last its report.

    Until the report is there the run is begun, and all can be written again.

    Args:
        run: its directory, which `cprl.runs.states.start` made.
        episodes: those of all groups, as an `EpisodeTracker` returned them for a world of each group; a
            group is a replica of the run.
        tables: further tables by the names of their files: `turns` is written as turns.parquet.

    Raises:
        FileExistsError: if the run is finished.
        ValueError: if these are not the episodes that the recipe announces.
    """
    refuse_to_write_over(run / REPORT)
    experiment = read_recipe(run)["experiment"]
    groups = range(experiment["replicas"])
    in_order = sorted(episodes, key=lambda episode: (episode.world, episode.episode))
    worlds = [episode.world for episode in in_order]
    if worlds != [group for group in groups for _ in range(experiment["episodes"])]:
        raise ValueError(
            f"episodes are of the worlds {worlds}; allowed in {run}: {experiment['episodes']} of each of "
            f"{len(groups)} groups"
        )
    played = {Path(FILE_NAME).stem: table_of(in_order, groups)}
    for name, table in {**played, **tables}.items():
        write_listed(run, f"{name}.parquet", partial(write_small, table))
    save_weights(run, {})
    write_json(run / REPORT, {"finished": time_now(), "episodes": experiment["episodes"]})


def absence(run: Path) -> str:
    """Return a sentence that says how often, and in which groups, nobody was there to act for an agent of a
    person; "" if all people played to the end."""
    if not (run / TURNS).is_file():
        return ""
    agents = enumerate(read_recipe(run)["experiment"]["agents"])
    turns = where(
        read_table(run / TURNS), agent=tuple(agent for agent, spec in agents if spec["kind"] == "Person")
    )
    missed = where(turns, person=False) if "person" in turns.column_names else turns[:0]
    if not len(missed):
        return ""
    groups = ", ".join(map(str, sorted(missed["group"].unique().to_pylist())))
    share = len(missed) / len(turns)
    return f"People had left, or never came, in {share:.0%} of their turns; groups of these turns: {groups}."
