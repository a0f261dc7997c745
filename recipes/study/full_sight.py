"""Does the tragedy come to agents that see the whole board, once they have had the time to learn?

    python recipes/study/full_sight.py --jobs 2 --block 4

In 200 episodes in one world agents with full sight get what random play gets. Here they learn for 2,000
episodes, from sixteen worlds at once.
"""

from dataclasses import replace

from base import TRAGEDY

import cprl

STUDY = cprl.Study(
    replace(TRAGEDY, episodes=2000),
    {"view": {"7 x 15": {}, "full board": {"game.observation.area": "full"}}},
    replicas=8,
    reference="view=7 x 15",
    name="full_sight",
    question="Does sight of the whole board save it from agents who have had the time to learn?",
    expectation=(
        "No: agents who see the whole board learn more slowly, since their own place is one mark among many "
        "and the board does not turn with them, but in the end they strip it, too. Their harvest rises above "
        "that of random play, then falls below it, later than with a window; at the end it is still higher "
        "than with a window, and no board lives for all of its 1,000 turns."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
