"""Draws the figures of docs, all in the style of `cprl.terminal.style`, from what is committed.

    python docs/draw_figures.py                          all of them, some ten minutes of a core
    python docs/draw_figures.py institutions governs

Films, screenshots (`SCREENSHOTS`) and the pages of the gallery have scripts of their own.
"""

import argparse
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

import cprl
from cprl.algorithms import DQN
from cprl.population import Learning
from cprl.runs.curves import curves_of
from cprl.studies import StudyTable
from cprl.studies.study_figures import by_condition, by_factor, figures_of

DOCS: Final = Path(__file__).parent
RESULTS: Final = DOCS / "results"
STUDY: Final = DOCS.parent / "recipes" / "study"
SCREENSHOTS: Final = ("viewer.png", "replay.png")
"""Pictures of Rerun's viewer, see docs/make_screenshot.py."""
REPORTED: Final = ("commons_targets_10", "single_basic")
"""The runs whose collective return docs/results.md shows."""
COMPARED: Final = (*REPORTED, "commons", "commons_decay_500k", "commons_published", "single_complex")
"""Runs on boards of the same sizes, whose figures have the same vertical range."""
APRIL_RANDOM_PLAY: Final = 99.24
"""What random play harvested under the fault of 10 April 2019, in apples; see docs/results/details.md."""

sys.path[:0] = [str(STUDY), str(STUDY / "theory"), str(STUDY / "governs")]


def draw_boards() -> None:
    """Draw each board as an episode begins, for docs/boards."""
    from draw_boards import draw_boards

    draw_boards()


def draw_institutions() -> None:
    """Draw each institution at work, and what all of them do to the tragedy."""
    from draw_institutions import draw_institutions
    from institutions_page import draw_courses

    draw_institutions()
    draw_courses(RESULTS / "studies", DOCS / "institutions" / "courses.png")


def draw_theory() -> None:
    """Draw the herders' game, where learners end in it, and the Schelling diagram of a board."""
    from draw_sharing import draw_herders
    from schelling import game_of
    from where_learners_end import draw

    from cprl.experimental.schelling import draw_schelling, schelling

    draw_herders()
    draw(pq.read_table(RESULTS / "theory" / "taken.parquet"), RESULTS / "theory" / "taken.png")
    played = schelling(game_of("commons", "as run"), cprl.Fresh(episodes=5), greedy="greedy")
    path = RESULTS / "schelling" / "commons_as_run_greedy.png"
    path.unlink(missing_ok=True)
    draw_schelling(played, path)


def draw_governs() -> None:
    """Draw what governs the commons, and write the page of its rows."""
    import governs_page
    from figure import PICTURES, draw

    for name, groups in PICTURES.items():
        draw(RESULTS / "governs" / name, groups)
    governs_page.main(out=RESULTS / "governs")


def draw_studies() -> None:
    """Draw the figures that each committed study has, of the episodes that its summary compares."""
    for summary in sorted((RESULTS / "studies").glob("*/summary.md")):
        study = summary.parent
        text = summary.read_text(encoding="utf-8")
        [last] = {int(number) for number in re.findall(r"^The last (?:\d+ to )?(\d+) episodes", text, re.M)}
        table = StudyTable.read(study / "table.parquet", last=last)
        for name, _, draw in figures_of(table):
            if (study / "figures" / name).exists():
                draw(study / "figures" / name)


def draw_learners() -> None:
    """Draw what each way to learn gets on two boards."""
    metrics = ("collective_return", "equality", "survival_steps")
    for board in ("two_complex", "commons"):
        folder = RESULTS / "learners" / board
        table = StudyTable.read(folder / "table.parquet", last=30)
        by_condition(table, folder / "levels.png", metrics=metrics)


def draw_reports() -> None:
    """Draw the training curves of docs/results.md beside the published ones."""
    from published_figures import draw_figures
    from results import read_result

    with TemporaryDirectory() as scratch:
        results = [read_result(RESULTS / name) for name in COMPARED]
        for result, metric, path in draw_figures(results, Path(scratch)):
            if result.name in REPORTED and metric == "collective_return":
                shutil.copyfile(path, RESULTS / "figures" / path.name)
        runs = RESULTS / "studies" / "experiment_3" / "runs"
        april_run = _with_the_fault(read_result(runs / "as_run"), runs / "both")
        for _, metric, path in draw_figures([april_run], Path(scratch)):
            if metric == "collective_return":
                shutil.copyfile(path, runs.parent / "report" / "figures" / path.name)


def _with_the_fault(as_run: Any, run: Path) -> Any:
    """Return a result with the curves of a run whose recipe has a rule that no game has any more; all that a
    figure needs else is that of the run beside it, but for the discount and random play."""

    class AprilRun(type(as_run)):
        random_game = None
        variant = "as_run_10_april"

        def evaluated(self, policy: str) -> dict[str, Any]:
            return {"collective_return": np.array([APRIL_RANDOM_PLAY])}

    agent = as_run.experiment.agents[0]
    settings = replace(agent.algorithm.settings, gamma=0.999)
    agents = (Learning(DQN(settings=settings)),) * len(as_run.experiment.agents)
    experiment = replace(as_run.experiment, agents=agents)
    values = {field.name: getattr(as_run, field.name) for field in fields(as_run)}
    return AprilRun(**values | {"paths": [run], "curves": curves_of(run), "experiment": experiment})


def draw_scenarios() -> None:
    """Draw how the agents of `commons` fare among strangers."""
    from scenarios_baseline import EPISODES, SEED

    from cprl.evaluation import run_scenarios
    from cprl.evaluation.scenarios import draw_scenarios

    played = run_scenarios(RESULTS / "commons", cprl.Fresh(episodes=EPISODES, seed=SEED))
    draw_scenarios(played, RESULTS / "scenarios" / "commons.png")


def run_cprl(*words: str, folder: Path | None = None) -> None:
    """Run the command `cprl` in a folder, without its lines."""
    subprocess.run([sys.executable, "-m", "cprl", *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)


def draw_empirical_game() -> None:
    """Draw the game of choosing among three runs, by the command of docs/evaluation.md."""
    runs = [str(RESULTS / "swap_the_loss" / name) for name in ("dqn", "ppo", "sac")]
    with TemporaryDirectory() as scratch:
        drawn = Path(scratch, "egta.png")
        run_cprl("egta", *runs, "--episodes", "4", "--figure", str(drawn))
        shutil.copyfile(drawn, RESULTS / "figures" / "egta_swap_the_loss.png")


def draw_film() -> None:
    """Draw the film of a tragedy, by the command of docs/play.md."""
    with TemporaryDirectory() as scratch:
        drawn = Path(scratch, "tragedy.gif")
        look = ["--every", "5", "--width", "560", "--out", str(drawn)]
        run_cprl("film", str(RESULTS / "commons_published"), "--replica", "1", "--episode", "0", *look)
        shutil.copyfile(drawn, DOCS / "tragedy.gif")


def draw_tutorial() -> None:
    """Draw the film and the quotas of the first hour, by the code and the commands of its page."""
    page = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    [recipe] = re.findall(r"```python\n(# first\.py\n.*?)```", page, re.DOTALL)
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "first.py").write_text(recipe, encoding="utf-8")
        play = [sys.executable, "first.py", "--watch", "off", "--out", "greedy"]
        subprocess.run(play, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        run_cprl("film", "greedy", "--out", "greedy.gif", "--width", "400", folder=folder)
        shutil.copyfile(folder / "greedy.gif", DOCS / "tutorial" / "greedy.gif")
        shares = "game.institutions.0.share=0.25,0.5,1,2"
        run_cprl("sweep", "first.py", "--quota", "1", "--vary", shares, "--out", "quota", folder=folder)
        table = StudyTable.read(folder / "quota" / "table.parquet", last=20)
    metrics = ("collective_return", "survival_steps")
    by_factor(table, "game.institutions.0.share", DOCS / "tutorial" / "quota.png", metrics=metrics)


GROUPS: Final[dict[str, Callable[[], None]]] = {
    "boards": draw_boards,
    "institutions": draw_institutions,
    "theory": draw_theory,
    "governs": draw_governs,
    "studies": draw_studies,
    "learners": draw_learners,
    "reports": draw_reports,
    "scenarios": draw_scenarios,
    "egta": draw_empirical_game,
    "film": draw_film,
    "tutorial": draw_tutorial,
}


def main() -> None:
    """Draw the groups of figures that are asked for, by default all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("groups", nargs="*", choices=[[], *GROUPS], metavar="GROUP", help=", ".join(GROUPS))
    for name in parser.parse_args().groups or GROUPS:
        GROUPS[name]()
        print(name, flush=True)


if __name__ == "__main__":
    main()
