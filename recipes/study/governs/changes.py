"""What governs the commons? One thing changed at a time: the resource, people, minds, weapons, rules.

    python recipes/study/governs/changes.py --jobs 2

See asking.py for what all studies of this folder share. 46 conditions, 8 replicas: some 2.2 core hours, 150
seconds of a core for a condition of four agents. Contradicted by: a difference from "nothing changed" on the
other side of 0, in the primary outcome and by Holm's method for all 45; for "same", one beyond the margin.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from asking import AGENT, EXPERIMENT, GAME, SETTINGS, Expectation, Sign, expected_text, game_with
from other_boards import BOARD, copies, crowded, half, quarters, scattered

import cprl
from cprl.algorithms import DQN, PPO, RolloutSettings
from cprl.institutions import (
    Boundaries,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.population import Learning

NOTHING: Final = "nothing changed"
QUOTA: Final = Quota(share=0.25, window_steps=50)
"""A quarter of the board's proven yield: 6 apples for each agent in 50 turns, 480 an episode, not more."""
LADDER: Final = GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 1, 2, 4), recovery_steps=50)
PPO_AGENT: Final = Learning(
    PPO(
        settings=RolloutSettings(
            gamma=SETTINGS.gamma, learning_rate=1e-3, rollout_steps=64, minibatch_size=256, epochs=4
        ),
        entropy_coeff=0.05,
    )
)
"""The settings of recipes/study/many_worlds.py for sixteen worlds, with the discount of all agents here."""


@dataclass(frozen=True)
class Change:
    """A condition, its group, and what is expected of its income beside nothing changed."""

    name: str
    group: str
    levels: dict[str, Any]
    sign: Sign
    why: str


def rule(*institutions: Institution) -> dict[str, Any]:
    return {"game.institutions": institutions}


def regrown(times: float) -> dict[str, Any]:
    probs = np.minimum(1, times * np.array(GAME.rules.regrow_prob))
    return {"game": game_with(regrow_prob=tuple(probs.tolist()))}


def learning(**settings: Any) -> dict[str, Any]:
    return {"agents": (Learning(DQN(settings=replace(SETTINGS, **settings))),) * 4}


def shared_by(agents: int) -> dict[str, Any]:
    return {"agents": (AGENT,) * agents, "game.map": crowded(agents)}


LESS_GROWS = "the board dies sooner and bears less"
FASTER = "apples grow faster than four agents can eat"
LITTLE = "as in the game as run: it lets agents strip the board"
STRIPS = Boundaries.strips(height=BOARD.height, width=BOARD.width, agents=4)
FINED = Boundaries.strips(height=BOARD.height, width=BOARD.width, agents=4, bite_fine=2.0, step_fine=0.1)

CHANGES: Final = (
    Change("regrowth x 0.25", "resource", regrown(0.25), "less", LESS_GROWS),
    Change("regrowth x 0.5", "resource", regrown(0.5), "less", LESS_GROWS),
    Change("regrowth x 2", "resource", regrown(2), "more", "a longer life, though no end of the tragedy"),
    Change("regrowth x 4", "resource", regrown(4), "more", FASTER),
    Change("half the apples, scattered", "resource", {"game.map": scattered(0.5)}, "less", LESS_GROWS),
    Change("as many apples, scattered", "resource", {"game.map": scattered(1)}, "less", "fewer neighbours"),
    Change("twice the apples, scattered", "resource", {"game.map": scattered(2)}, "more", FASTER),
    Change("as many apples, in patches", "resource", {"game.map": scattered(1, 0.95)}, "more", "they regrow"),
    Change("half the board", "resource", {"game.map": half()}, "less", "half the apples for as many agents"),
    Change("twice the board", "resource", {"game.map": copies(2)}, "more", "twice the apples"),
    Change("four times the board", "resource", {"game.map": copies(4)}, "more", "four times the apples"),
    Change(
        "quarters, open", "resource", {"game.map": quarters("ground")}, "same", "two lines of bare ground"
    ),
    Change(
        "quarters, walls", "resource", {"game.map": quarters("walls")}, "more", "what is spared is one's own"
    ),
    Change("2 agents", "people", shared_by(2), "more", "half as many bites at a time"),
    Change("8 agents", "people", shared_by(8), "less", "twice as many bites at a time"),
    Change("12 agents", "people", shared_by(12), "less", "three times as many bites at a time"),
    Change("discount 0", "minds", learning(gamma=0.0), "same", "they have not learned to harvest far apples"),
    Change("discount 0.9", "minds", learning(gamma=0.9), "same", "a bite comes within ten turns"),
    Change("discount 0.995", "minds", learning(gamma=0.995), "more", "what is spared regrows in 200 turns"),
    Change("networks of 2 units", "minds", learning(hidden_cells=(2, 2)), "more", "they harvest slowly"),
    Change("networks of 128 units", "minds", learning(hidden_cells=(128, 128)), "same", "32 units suffice"),
    Change("PPO", "minds", {"agents": (PPO_AGENT,) * 4}, "more", "random policies strip the board less"),
    Change(
        *("sight 3 x 7", "minds", {"game": game_with(window_rows=3, window_columns=7)}),
        *("more", "who sees fewer apples harvests more slowly"),
    ),
    Change(
        *("sight 11 x 23", "minds", {"game": game_with(window_rows=11, window_columns=23)}),
        *("same", "a window of 7 x 15 has all that an agent reaches in ten turns"),
    ),
    Change(
        *("sight of the whole board", "minds", {"game.observation.area": "full"}),
        *("same", "it is not turned with the agent: slow to learn, so frozen as random play"),
    ),
    Change("no beam", "weapons", {"game": game_with(may_fire=False)}, "same", "tags are rare and balance"),
    Change(
        "two hits tag", "weapons", {"game": game_with(hits_to_tag=2)}, "same", "tags are rare and balance"
    ),
    Change(
        "time-out 5", "weapons", {"game": game_with(freeze_steps=5)}, "same", "a tag costs little either way"
    ),
    Change(
        "time-out 100", "weapons", {"game": game_with(freeze_steps=100)}, "same", "some 20 apples, as run"
    ),
    Change("time-out 400", "weapons", {"game": game_with(freeze_steps=400)}, "more", "fewer are in play"),
    Change("cheap talk", "people", {"game": game_with(signals=4)}, "same", "a signal binds nobody"),
    Change("boundaries (1)", "institutions", rule(STRIPS), "more", "an owner meets the future of his strip"),
    Change("fines for regions (1)", "institutions", rule(FINED), "same", "fines eat what the board gains"),
    Change("quota (2)", "institutions", rule(QUOTA), "more", "its cap of 480 is above what learners get"),
    Change(
        "vote on a tax (3)",
        "institutions",
        rule(Vote(on=Tax(), choices=(0, 0.25, 0.5, 0.75))),
        "same",
        LITTLE,
    ),
    Change(
        *("monitored quota (4)", "institutions", rule(replace(QUOTA, fine=2.0), Monitoring(prob=0.5))),
        *("same", "the fine takes on average what the bite brings"),
    ),
    Change(
        *("certain fine of 2 (5)", "institutions", rule(replace(QUOTA, fine=2.0))),
        *("more", "a fine above the gain of a breach"),
    ),
    Change(
        *("certain fine of 1 (5)", "institutions", rule(replace(QUOTA, fine=1.0))),
        *("same", "a fine of just the gain of a breach"),
    ),
    Change(
        *("graduated sanctions (5)", "institutions", rule(replace(QUOTA, fine=0.0), LADDER)),
        *("more", "who breaks the quota often is out of play"),
    ),
    Change(
        *("sanctions without fines (5)", "institutions"),
        rule(replace(QUOTA, fine=0.0), replace(LADDER, fines=(0, 0, 0, 0))),
        *("more", "the same, and no apple is lost to fines"),
    ),
    Change(
        *("one agent may punish (5)", "institutions"),
        {"game": game_with(replace(GAME, institutions=(Sanctioner(agents=(0,)),)), freeze_steps=100)},
        *("same", "one beam does not hold three agents"),
    ),
    Change(
        *("mediation (6)", "institutions"),
        {
            **rule(replace(QUOTA, fine=0.0), Mediation(turns=50, refund=1.0)),
            "game.observation.agents_apart": True,
        },
        *("same", LITTLE),
    ),
    Change("elected sanctioner (7)", "institutions", rule(Sanctioner()), "same", LITTLE),
    Change(
        *("nested levies (8)", "institutions"),
        rule(Levies(groups=((0, 1), (2, 3)), local_rate=0.3, joint_rate=0.2)),
        *("same", LITTLE),
    ),
    Change(
        *("tax of 0.77, shared", "institutions", rule(Tax(rate=0.77))),
        *("more", "0.42 of a bite is the agent's own: near the threshold of exchanged rewards"),
    ),
)
"""In brackets: Ostrom's principle."""

EXPECTATIONS: Final = tuple(
    Expectation(label=change.name, more=(change.name,), less=(NOTHING,), sign=change.sign, why=change.why)
    for change in CHANGES
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={NOTHING: {}, **{change.name: change.levels for change in CHANGES}},
    name="changes",
    question="Which changes keep the commons alive?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
