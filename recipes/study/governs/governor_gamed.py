"""Can a learned rule be gamed, and does it fit learners of another kind? Governors of governor.py, frozen.

    python recipes/study/governs/governor.py --jobs 2
    python recipes/study/governs/governor_gamed.py --jobs 2

Agent 0 is replaced by a responder, as in best_response.py, among the three others and under the governor of
its replica, all of which stay as they are. Then four agents learn by PPO: under the same frozen governors,
which have met DQN agents alone, and beside a governor that learns with them.

8 conditions, 8 replicas: some 0.4 core hours. Contradicted by: a responder that gains 12.5 apples, a quarter
of the margin for four agents; a rule that does nothing for PPO agents, or less than one made for them. One
family of all 8, by Holm's method.
"""

from dataclasses import replace
from typing import Any, Final

from asking import EXPERIMENT, GAME, Expectation, expected_text, trained
from best_response import gain, responders
from changes import PPO_AGENT
from governor import LEARNED, STUDY as GOVERNOR
from governor_kept import LEARNED as RULES

import cprl
from cprl.population import Frozen

PPO_ALONE: Final = "changes/PPO"


def conditions() -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = {}
    for rule, institutions in RULES.items():
        game = replace(GAME, institutions=institutions)
        replaced, *others = trained(GOVERNOR, f"{rule} learned")
        governor = Frozen(replaced.run, GAME.agents, replica=None)
        for start, responder in responders(replaced).items():
            agents = (responder, *others)
            table[f"{rule}, from {start}"] = {"game": game, "agents": agents, "governor": governor}
        ppo_agents = (PPO_AGENT,) * GAME.agents
        table[f"{rule} kept, PPO"] = {"game": game, "agents": ppo_agents, "governor": governor}
        table[f"{rule} learned, PPO"] = {"game": game, "agents": ppo_agents, "governor": LEARNED}
    return table


EXPECTATIONS: Final = tuple(
    expected
    for rule in RULES
    for expected in (
        *(
            gain(
                f"gain under the learned {rule}, from {start}",
                responder=f"{rule}, from {start}",
                incumbents=f"governor/{rule} learned",
                sign="same",
                why="one agent of four moves little of what the governor sees",
            )
            for start in ("a copy", "nothing")
        ),
        Expectation(
            label=f"PPO agents: {rule} kept - no rule",
            more=(f"{rule} kept, PPO",),
            less=(PPO_ALONE,),
            sign="more",
            why="it helps DQN agents, whose board it saves",
        ),
        Expectation(
            label=f"PPO agents: {rule} kept - learned with them",
            more=(f"{rule} kept, PPO",),
            less=(f"{rule} learned, PPO",),
            sign="same",
            why="as with fresh DQN agents",
        ),
    )
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions=conditions(),
    name="governor_gamed",
    question="Can a learned rule be gamed, and does it fit learners of another kind?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
