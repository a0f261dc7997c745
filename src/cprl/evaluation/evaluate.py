"""evaluate_run: compares the agents of a stored run with the random policy in fresh worlds."""

from pathlib import Path

import pyarrow as pa

from cprl.evaluation.pages import heading
from cprl.evaluation.populations import agents_of, fresh_for, join_tables, play_fresh, scripted_agent
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.training.stored import LoadedRun, as_loaded


@working("evaluating")
def evaluate_run(run: str | Path | LoadedRun, fresh: Fresh = Fresh()) -> pa.Table:
    """Let every replica of a stored run play fresh episodes, and the random policy in the same worlds.

    Args:
        run: the directory of the run, its exported results, or a value of `cprl.load`. If the run has not
            ended, the agents of its newest checkpoint play.
        fresh: the number of episodes, their seed, and the replicas that play.

    Returns:
        A table with a row for each policy, replica, episode and agent, see `cprl.measuring.table`. The column
        "policy" says "trained" or "random".
    """
    loaded = as_loaded(run)
    fresh = fresh_for([loaded], fresh)
    policies = {"trained": agents_of(loaded), "random": [scripted_agent("random")] * loaded.game.agents}
    return join_tables(
        (play_fresh(fresh, loaded, agents, {"policy": policy}) for policy, agents in policies.items()),
        heading=heading(loaded.path.name, fresh, [loaded]),
        weights=loaded.weights_from,
    )
