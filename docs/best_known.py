"""What the boards with a name could give: the rows of `cprl.measuring.possible.KNOWN`, computed again.

    python docs/best_known.py

Some minutes of a core.
"""

from cprl import presets
from cprl.measuring.possible import computed

if __name__ == "__main__":
    for board in presets.BOARDS:
        for variant in ("published", "as_run"):
            found = computed(presets.game(board, variant=variant))
            print(
                f'    ("{board}", "{variant}"): Possible(\n        best_known={found.best_known:.1f}, '
                f"error={found.error:.1f}, policy=_PLANNER, at_most={found.at_most:.1f}\n    ),",
                flush=True,
            )
