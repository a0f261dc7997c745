"""What if agents see more? Windows of four sizes, and the full board.

python recipes/study/view.py --jobs 2
"""

from base import EXPERIMENT

import cprl

WINDOWS = {"3 x 7": (3, 7), "7 x 15": (7, 15), "11 x 23": (11, 23)}

STUDY = cprl.Study(
    EXPERIMENT,
    {
        "view": {
            **{
                name: {"game.rules.window_rows": rows, "game.rules.window_columns": columns}
                for name, (rows, columns) in WINDOWS.items()
            },
            "full board": {"game.observation.area": "full"},
        }
    },
    reference="view=7 x 15",
    name="view",
    question="What if agents see less, more, or the whole board?",
    expectation=(
        "Agents who see less find fewer apples and harvest more slowly, so the board lives longer and "
        "the harvest of an episode is higher. The full board is not rotated with the agent, which makes "
        "it harder to learn from: on this short schedule agents harvest worse than with the window, so "
        "survival is higher."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
