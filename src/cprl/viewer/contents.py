"""The contents of a recording: what is plotted of a game, and what its recording lacks."""

from collections.abc import Mapping, Sequence
from typing import Final

from torchrl.envs import EnvBase

from cprl.measuring import institutional, phases
from cprl.measuring.reported import FIELDS, METRICS, available, left_out
from cprl.measuring.yields import yield_of
from cprl.viewer.scenery import Curves

_SHOWN: Final[Mapping[str, tuple[str, ...]]] = {
    "phases and new bests": tuple(dict.fromkeys(entry for name in phases.METRICS for entry in METRICS[name])),
    "who tagged whom": ("tagged_by",),
    "the Lorenz curve": ("harvest",),
    "all boards side by side": ("board",),
    "where agents go": ("board",),
    "the stock over the turn": ("board",),
    "the board and what agents see": ("board",),
}
"""The views of a recording besides metrics, and the entries that each needs."""


def curves_of(env: EnvBase, agents: tuple[str, ...], reported: Sequence[str], *, episodes: int) -> Curves:
    """The numbers of an environment that are plotted.

    Args:
        env: a world for each replica.
        agents: their names.
        reported: the optional entries that the game reports.
        episodes: of the run.
    """
    metrics = available({**METRICS, "stock_left": FIELDS["stock_left"]}, reported)
    metrics += () if yield_of(env)["sustainable_yield"] is None else ("yield_share",)
    return Curves(
        agents=agents,
        replicas=env.batch_size.numel(),
        metrics=metrics,
        has_phases=episodes in phases.EPISODES and set(phases.METRICS) <= set(metrics),
        has_tags="tagged_by" in reported,
        institutions=institutional.metrics_of(env, reported),
        in_force=institutional.decisions_of(env) if "in_force" in reported else (),
    )


def missing_in(reported: Sequence[str], *, has_board: bool) -> str:
    """One line that names what the recording lacks, and why; "" if it lacks nothing."""
    return left_out([*reported, *(["board"] if has_board else [])], more=_SHOWN)
