"""The pages and moving boards of docs/gallery.md, of runs of recipes/institutions.py.

for name in none quota boundaries graduated_sanctions monitoring vote mediation sanctioner levies; do
    python recipes/institutions.py --institution $name --replicas 1 --watch off --out runs/$name
done
python docs/draw_gallery.py --runs runs

The committed pictures of none and quota are replica 0 of runs with 16 replicas, without `--replicas 1`.
"""

from pathlib import Path
from typing import Final

import tyro

from cprl.commons.picture import world_image
from cprl.evaluation.film import fresh_episode, play_to_show
from cprl.evaluation.film_pictures import write_gif
from cprl.evaluation.lanes import commons_game
from cprl.evaluation.show import show

TITLES: Final = {
    "none": "No rule",
    "boundaries": "Boundaries",
    "quota": "A quota",
    "vote": "A vote on a tax",
    "monitoring": "A monitored quota",
    "graduated_sanctions": "Graduated sanctions",
    "mediation": "Mediation",
    "sanctioner": "An elected sanctioner",
    "levies": "Nested levies",
}
CELL_PIXELS: Final = 9
EVERY: Final = 12
"""Turns from one picture of a board to the next."""


def main(*, runs: Path, out: Path = Path(__file__).parent / "gallery") -> None:
    """Make NAME.html and NAME.gif of each run.

    Args:
        runs: the directory that holds the runs, by the names of the institutions.
        out: the directory of the files.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, title in TITLES.items():
        page = out / f"{name}.html"
        page.unlink(missing_ok=True)
        show(runs / name, page, titles=[title])
        fresh = fresh_episode(runs / name)
        moments = play_to_show(fresh).moments
        shown = [*moments[::EVERY], moments[-1]]
        board = commons_game(fresh.run).map
        pictures = [world_image(board, moment, cell_pixels=CELL_PIXELS) for moment in shown]
        write_gif(out / f"{name}.gif", pictures, pictures[:: max(1, len(pictures) // 8)], fps=12)
        print(f"{name}: {moments[-1].harvested.sum()} apples, {len(moments) - 1} turns", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
