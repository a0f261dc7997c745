"""One update of teams that learn by LOLA: microseconds of the CPU, for teams of two and four.

One thread, window 7 x 15 x 3, two hidden layers of 32 and 8 actions. An update takes two rollouts of the
present weights by policy gradients, one and one for each member by DiCE, of 250 steps each: rollouts that are
full of made-up transitions are updated from again and again. Best of several repeats; "policies" is the step
of the policies, "critics" one step of the critics over the same rollouts, of which an update makes ten by
default, and "look ahead" what DiCE does once more, after the first rollout. Nothing is compiled.

    python benchmarks/lola_updates.py
"""

import time
from collections.abc import Callable

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import presets
from cprl.algorithms import LOLA, LOLASettings
from cprl.learners.lola.learner import LOLALearner


def filled(estimator: str, learners: int, members: int, rollout_steps: int) -> LOLALearner:
    """A learner of so many agents in teams of two or four, with full rollouts."""
    algorithm = LOLA(settings=LOLASettings(rollout_steps=rollout_steps), estimator=estimator)  # type: ignore[arg-type]
    spaces = presets.game("commons").spaces
    learner = algorithm.make_learner(
        spaces, agents=tuple(range(members)), replicas=learners // members, engine="eager"
    )
    assert isinstance(learner, LOLALearner)
    chance = torch.Generator().manual_seed(0)
    for name, field in learner._rollouts.items():
        highest = {"action": spaces.actions, "done": 1, "terminated": 1, "reward": 2}.get(name, 256)
        field.copy_(torch.randint(highest, field.shape, generator=chance))
    return learner


def microseconds(run: Callable[[], object], repeats: int) -> float:
    """The best of several repeats."""
    run()
    best = float("inf")
    for _ in range(repeats):
        began = time.process_time()
        run()
        best = min(best, time.process_time() - began)
    return best * 1e6


def main(*, learners: tuple[int, ...] = (4, 32), rollout_steps: int = 250, repeats: int = 10) -> None:
    """Prints the table.

    Args:
        learners: how many agents learn at once, multiples of four.
        rollout_steps: the length of a rollout.
        repeats: of which the best counts.
    """
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    table = Table("estimator", "team of", "part", title=f"us an update, rollouts of {rollout_steps} steps")
    for count in learners:
        table.add_column(f"{count} agents", justify="right", no_wrap=True)
    for estimator in ("policy_gradient", "dice"):
        for members in (2, 4):
            rows: dict[str, list[str]] = {}
            for count in learners:
                made = filled(estimator, count, members, rollout_steps)
                observation, rollouts, target = made._batch(made.rollouts)
                of_dice = estimator == "dice"
                given = rollouts.unsqueeze(2) if of_dice else rollouts
                parts: dict[str, Callable[[], object]] = {
                    "policies": lambda made=made, given=given: made.engine.update_policies(given),  # type: ignore[misc]
                    "critics": lambda made=made, seen=observation, wanted=target: (  # type: ignore[misc]
                        made.engine.update_critics(seen, wanted)
                    ),
                }
                if of_dice:
                    parts["look ahead"] = lambda made=made, first=rollouts[:, :1]: (  # type: ignore[misc]
                        made.engine.look_ahead(first)
                    )
                for name, part in parts.items():
                    rows.setdefault(name, []).append(f"{microseconds(part, repeats):,.0f}")
            for name, cells in rows.items():
                table.add_row(estimator, str(members), name, *cells)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
