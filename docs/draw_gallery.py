"""The pages and moving boards of docs/gallery.md, of runs of recipes/institutions.py.

for name in none quota boundaries graduated_sanctions monitoring vote mediation sanctioner levies; do
    python recipes/institutions.py --institution $name --watch off --out runs/$name
done
python docs/draw_gallery.py --runs runs

Without `--runs` the pages are made again of the episodes that they hold, in the words of today.
"""

import json
import re
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from typing import Any, Final

import tyro

from cprl import Experiment
from cprl.evaluation.fresh import fresh_episodes, record
from cprl.evaluation.populations import commons_game
from cprl.evaluation.video_files import write_gif
from cprl.pictures.image import world_image
from cprl.pictures.readable import legend_of
from cprl.population import specs_by_agent
from cprl.web.scenes import scene_json
from cprl.web.show import about, begins, page, show

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


def with_new_words(text: str, experiment: Experiment) -> str:
    """Return a page that shows the episode of another, of the same experiment, as `show` writes it now."""
    data: dict[str, Any] = json.loads(
        re.findall(r'id="data" type="application/json">(.*?)</script>', text)[0]
    )
    (population,) = data["populations"]
    game: Any = experiment.game
    specs = specs_by_agent(experiment.agents, game.agents)
    run: Any = SimpleNamespace(experiment=experiment, game=game, specs=specs, networks=specs)
    population |= {"about": about(run), **scene_json(game)}
    data.pop("palette", None)
    data["legend"] = legend_of([game])
    return page(population["title"], begins(game), data)


def main(*, runs: Path | None = None, out: Path = Path(__file__).parent / "gallery") -> None:
    """Make NAME.html and NAME.gif of each run.

    Args:
        runs: the directory that holds the runs, by the names of the institutions.
        out: the directory of the files.
    """
    if runs is None:
        recipe = run_path(str(Path(__file__).parents[1] / "recipes" / "institutions.py"))
        for name in TITLES:
            path = out / f"{name}.html"
            text = with_new_words(path.read_text(encoding="utf-8"), recipe["experiment"](institution=name))
            path.write_text(text, encoding="utf-8")
        return
    out.mkdir(parents=True, exist_ok=True)
    for name, title in TITLES.items():
        path = out / f"{name}.html"
        path.unlink(missing_ok=True)
        show(runs / name, path, titles=[title])
        (fresh,) = fresh_episodes([runs / name])
        moments = record(fresh).boards
        shown = [*moments[::EVERY], moments[-1]]
        board = commons_game(fresh.run).map
        pictures = [world_image(board, moment, cell_pixels=CELL_PIXELS) for moment in shown]
        write_gif(out / f"{name}.gif", pictures, pictures[:: max(1, len(pictures) // 8)], fps=12)
        print(f"{name}: {moments[-1].harvested.sum()} apples, {len(moments) - 1} turns", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
