"""What each form of observation costs: environment steps of one thread, and how many times the RGB window's.

"apart" tells agents apart, "scores" adds the scoreboard and the stock gauge. The commons board, 4 agents,
1024 worlds, random actions drawn beforehand; all forms in one run, the best of several rounds through all of
them.

    make bench
"""

from dataclasses import replace

import torch
import tyro
from env_steps import Rate, kernel, through_step
from rich.console import Console
from rich.table import Table

from cprl import Game, Observation, presets

PLAIN = Observation()
FORMS = {
    "window, rgb": PLAIN,
    "window, rgb, apart": Observation(agents_apart=True),
    "window, one_hot": Observation(encoding="one_hot"),
    "window, one_hot, apart": Observation(encoding="one_hot", agents_apart=True),
    "full, rgb": Observation(area="full"),
    "full, rgb, apart": Observation(area="full", agents_apart=True),
    "full, one_hot": Observation(area="full", encoding="one_hot"),
    "full, one_hot, apart": Observation(area="full", encoding="one_hot", agents_apart=True),
    "window, rgb, scores": Observation(scoreboard=True, stock_gauge=True),
}


def games() -> dict[str, Game]:
    """Return the commons board under every form."""
    game = presets.game("commons")
    return {name: replace(game, observation=form) for name, form in FORMS.items()}


def main(*, worlds: int = 1024, turns: int = 100, rounds: int = 5) -> None:
    """Print the table.

    Args:
        worlds: the batch size.
        turns: turns timed at a time.
        rounds: of which the best counts.
    """
    ways = {"kernel": kernel, "env.step": through_step}
    best: dict[tuple[str, str], Rate] = {}
    for _ in range(rounds):
        for form, game in games().items():
            for engine, measure in ways.items():
                rate = measure(game, worlds, 1, turns, 1)
                if (form, engine) not in best or rate.step_us < best[form, engine].step_us:
                    best[form, engine] = rate
    table = Table(title=f"{worlds:,} worlds, one thread: steps per second")
    for column in ("observation", "shape"):
        table.add_column(column, no_wrap=True)
    for engine in ways:
        table.add_column(engine, justify="right", no_wrap=True)
        table.add_column("x", justify="right", no_wrap=True)
    for form, game in games().items():
        row = [form, " x ".join(map(str, game.observation_shape))]
        for engine in ways:
            rate = best[form, engine]
            plain = best["window, rgb", engine]
            row += [f"{rate.steps_per_cpu_s:,.0f}", f"{plain.step_us / rate.step_us:.2f}"]
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(main)
