"""Institutions in recordings, replays, tables and figures; games without them are shown as before."""

import re
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from drawings import frames_of
from matplotlib.image import imread
from paying_game import Charges
from places import ROOT
from random_agents import random_agents
from recordings import column, names, static
from rerun.chunk import RrdReader
from rich.console import Console
from torchrl.envs import TransformedEnv

import cprl
from cprl import CommonsEnv, Custom, Experiment, Game, Rules, maps
from cprl.evaluation import Fresh, evaluate_run
from cprl.evaluation.film import Style, film_episode, record_episode
from cprl.institutions import Boundaries, GraduatedSanctions, Monitoring, Sanctioner, Tax, Vote
from cprl.measuring.registry import reported_by
from cprl.measuring.statistics import estimates, number_format
from cprl.measuring.table import where
from cprl.pictures.episode_picture import EpisodePicture
from cprl.pictures.image import regions_of
from cprl.population import Scripted
from cprl.runs.episodes import read_episodes
from cprl.terminal.figures import training_curve
from cprl.terminal.summary import comparison_table, summarise
from cprl.training import Schedule, train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.header import describe_institutions
from cprl.viewer.layout import layout, styles
from cprl.viewer.pictures import borders
from cprl.viewer.replay_views import ViolationMarks
from cprl.viewer.scene import Curves, plotted_numbers

GAME = Game(
    map=maps.parse(".A>.A.A\n.A#A.AA\nv.<.AA>"),
    rules=Rules(regrow_prob=(0.02, 0.1), window_rows=5, window_columns=5, episode_steps=30),
)
AGENTS = 4
ALLOW = ("paying_game:Charges",)


class Remembers:
    """The episodes, and who broke a rule where in each turn of the first world."""

    def __init__(self, env):
        self.env, self.episodes, self.violators = env, [], []

    def on_step(self, batch):
        violated = batch["next", "agents", "violated"][0].numpy()
        now = self.env.worlds.show(self.env.output)
        self.violators.append([(now.row[agent], now.col[agent]) for agent in np.flatnonzero(violated)])

    def on_episode(self, episode, learning):
        self.episodes.append(episode)


def recorded(folder, env, *, replicas=1, episodes=2, callbacks=(), **options):
    """Trains random agents under the eyes of a viewer, which is returned."""
    others = random_agents(GAME.spaces, tuple(range(AGENTS)), replicas=replicas, seed=1)
    with ViewerCallback(folder, env, title="run", episodes=episodes, **options) as viewer:
        watching = [made(viewer) if callable(made) else made for made in callbacks]
        train(
            env,
            {},
            Schedule(episodes=episodes),
            others=others,
            callbacks=[*watching[:1], viewer, *watching[1:]],
        )
    return viewer


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    env = TransformedEnv(CommonsEnv(GAME, 2, seed=1), Charges())
    seen = Remembers(env.base_env)
    viewer = recorded(folder, env, replicas=2, episodes=4, callbacks=[seen])
    return folder / "run.rrd", viewer, seen


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of scripted agents under institutions, from its recipe."""
    experiment = Experiment(
        name="own",
        game=GAME,
        agents=tuple(Scripted(policy) for policy in ("greedy", "random", "random", "greedy")),
        episodes=6,
        replicas=2,
        transforms=(Custom("paying_game:Charges"),),
        evaluation_episodes=2,
    )
    cprl.trust(*ALLOW)
    return cprl.run(experiment, out=tmp_path_factory.mktemp("whole") / "run")


def entities(path):
    return {chunk.entity_path.strip("/") for chunk in RrdReader(path).stream()}


def test_the_lines_of_institutions_are_each_replica_their_mean_and_its_running_mean(run):
    path, viewer, seen = run
    _, logged = column(path, "institutions/violations", "Scalars:scalars", "episode")
    for number, line in enumerate(logged):
        episodes = [episode for episode in seen.episodes if episode.episode == number]
        each = [
            episode.metrics["institutions/violations"]
            for episode in sorted(episodes, key=lambda one: one.world)
        ]
        assert line[:3] == [*each, np.mean(each)]
    assert len(logged[0]) == 4
    names = static(path, "institutions/violations", "SeriesLines:names")
    assert list(names) == ["replicas", "replicas", "episodes", "violations"]
    _, in_force = column(path, "institutions/in_force_0", "Scalars:scalars", "episode")
    assert [line[0] for line in in_force] == [0.5] * 4
    _, texts = column(path, "log", "TextLog:text", "episode")
    said = next(text for (text,) in texts if text.startswith("episode 0: decision 0: 0.5; "))
    first = next(one for one in seen.episodes if (one.world, one.episode) == (0, 0))
    assert said == f"episode 0: {describe_institutions(first, viewer.logger.curves)}"
    assert f"{first.violations.sum()} violations; fined {first.fines[0]:.4g}, " in said


def test_each_agent_has_lines_of_what_it_paid_got_and_broke(run):
    path, _, seen = run
    for name in ("fines", "transfers", "violations"):
        for agent in range(AGENTS):
            _, logged = column(path, f"agent_{agent}/{name}", "Scalars:scalars", "episode")
            means = [
                np.mean([getattr(one, name)[agent] for one in seen.episodes if one.episode == number])
                for number in range(4)
            ]
            assert [line[0] for line in logged] == pytest.approx(means)


def test_only_games_with_institutions_have_their_tabs(run):
    _, viewer, _ = run
    curves = viewer.logger.curves
    tabs = {
        "Institutions",
        "Violations, turns",
        "Fines of each, apples",
        "Transfers to each, apples",
        "Shares of turns, bites, violations, tags",
        "Equality of incomes",
        "In force: decision 0",
    }
    assert tabs <= set(names(layout(curves).root_container))
    without = Curves(agents=("a", "b"))
    assert not without.has_institutions
    assert not tabs & set(names(layout(without).root_container))
    assert not [entity for entity in styles(without) if "institutions" in entity]


def test_a_recording_without_institutions_has_nothing_of_them(tmp_path):
    recorded(tmp_path, CommonsEnv(GAME, 1, seed=1))
    words = ("institutions", "fines", "transfers", "violat", "regions", "paid", "given")
    assert not [name for name in entities(tmp_path / "run.rrd") if any(word in name for word in words)]


@pytest.mark.integration
def test_a_replay_marks_who_breaks_a_rule_in_its_turn_and_shows_payments(whole, tmp_path):
    cprl.trust(*ALLOW)
    path, episode = record_episode(whole, tmp_path / "replay.rrd")
    frames, marks = column(path, "world/violators", "LineStrips2D:strips", "frame")
    assert frames == list(range(episode.steps - 1)), "the last turn has no frame"
    _, texts = column(path, "log", "TextLog:text", "step")
    broken = [text for (text,) in texts if "breaks a rule" in text]
    assert len(broken) == episode.violations.sum() > 0
    assert broken[0].split(": ")[1].endswith("fined 1.5") or "fined 1.75" in broken[0]
    last = [text for text in broken if text.startswith(f"step {episode.steps}:")]
    assert sum(len(own) for own in marks) == len(broken) - len(last)
    for agent in range(AGENTS):
        steps, paid = column(path, f"agent_{agent}/paid", "Scalars:scalars", "step")
        _, given = column(path, f"agent_{agent}/given", "Scalars:scalars", "step")
        assert steps == list(range(1, episode.steps + 1))
        assert -np.sum(paid) == pytest.approx(episode.fines[agent])
        assert np.sum(given) == pytest.approx(episode.transfers[agent])


def test_a_mark_is_a_diamond_around_the_agent(tmp_path):
    env = TransformedEnv(CommonsEnv(GAME, 1, seed=1), Charges())
    seen = Remembers(env.base_env)

    def marking(viewer):
        return ViolationMarks(viewer.logger, env.base_env)

    recorded(tmp_path, env, episodes=1, replay="run.rrd", callbacks=[seen, marking])
    _, marks = column(tmp_path / "run.rrd", "world/violators", "LineStrips2D:strips", "frame")
    for violators, diamonds in zip(seen.violators, marks, strict=False):
        middles = [np.mean(np.array(diamond)[:4], 0).tolist() for diamond in diamonds]
        assert middles == [pytest.approx([col + 1.5, row + 1.5], abs=1e-5) for row, col in violators], (
            "(x, y), with a rim"
        )
    assert sum(map(len, marks)) > 3


@pytest.mark.integration
def test_a_film_marks_who_broke_a_rule_since_its_last_picture(whole, tmp_path):
    cprl.trust(*ALLOW)
    path, (episode,) = film_episode(whole, tmp_path / "film.gif", style=Style(width=400, every=1))
    assert episode.violations.sum() > 0
    pictures, _ = frames_of(path)
    picture = EpisodePicture(GAME.map, steps=30, width=400)
    board = slice(*(round(picture.cell_box(row, 0)[1]) for row in (0, GAME.map.height)))
    white = (pictures[:, board].astype(int).min(-1) > 215).sum((1, 2))
    assert white[0] < white.max() / 2, "nobody has broken a rule when it begins"


def test_a_picture_has_a_white_diamond_around_a_violator():
    env = CommonsEnv(GAME, 1, seed=1)
    env.reset()
    now = env.worlds.show(env.output)
    picture = EpisodePicture(GAME.map, steps=30, width=400)
    plain, marked = (picture.draw([now], "own", violators=own) for own in ((), (2,)))
    rows, cols = np.nonzero((plain != marked).any(-1))
    left, _, right, bottom = picture.cell_box(int(now.row[2]), int(now.col[2]))
    beyond = 0.22 * (right - left)
    assert cols.min() == pytest.approx(left - beyond, abs=3)
    assert rows.max() == pytest.approx(bottom + beyond, abs=3)
    assert (marked[rows, cols].min(-1) > 100).mean() > 0.9


def test_the_borders_of_regions_are_lines_in_their_owners_hue():
    # Agent 0 owns the left column of two rows, both own the cell on the top right:  a b
    #                                                                              a .
    cells = [([0], np.array([[1, 0], [1, 0]], bool)), ([0, 1], np.array([[0, 1], [0, 0]], bool))]
    made = borders(cells)
    strips = [np.array(own) for own in made.strips.as_arrow_array().to_pylist()]
    assert len(strips) == 6 + 4, "around two cells, around one"
    # the right side of the cell (1, 0): x from 1 to 2 and y from 2 to 3 with the rim, 0.08 inside
    assert any(np.allclose(own, [(1.92, 2.0), (1.92, 3.0)], atol=1e-6) for own in strips[:6])
    colours = made.colors.as_arrow_array().to_pylist()
    assert len(set(colours[:6])) == len(set(colours[6:])) == 1
    assert colours[0] != colours[6]


def printed(what):
    console = Console(width=110, record=True, file=StringIO())
    console.print(what)
    return console.export_text()


@pytest.fixture(scope="module")
def evaluation(whole):
    cprl.trust(*ALLOW)
    return evaluate_run(whole, Fresh(episodes=2))


def test_the_page_of_a_run_has_a_row_for_each_number_of_institutions(whole, evaluation):
    played = evaluation
    console = Console(width=140, record=True, file=StringIO())
    summarise(whole, title="own", played=played, console=console)
    text = console.export_text()
    lines = (re.split("[│┃]", line)[1:-1] for line in text.splitlines())
    rows = {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines if cells}
    policies = [where(played, policy=policy) for policy in ("trained", "random")]
    paid = [where(rows, agent=0)["institutions/fines"].to_numpy().mean() for rows in policies]
    assert [cell.split()[0] for cell in rows["fines of all, apples"][:2]] == [
        f"{one:{number_format(one)}}" for one in paid
    ]
    of_agent = estimates(played, ["agent_1/fines", "agent_1/violations"], "policy").of("trained")
    assert rows["agent 1: fines, apples"][0] == str(of_agent["agent_1/fines"])
    assert rows["agent 1: violations"][0] == str(of_agent["agent_1/violations"])
    assert "in force: decision 0" in rows
    assert "violations per turn in play, 0 to 1" in rows
    assert "where one may bite" not in text, "nothing counted a bite"


def test_an_evaluation_reports_institutions(evaluation):
    numbers = ["institutions/detection_rate", "agent_2/fines", "income_equality"]
    measures = estimates(evaluation, numbers, by="policy").of("random")
    assert measures["institutions/detection_rate"].value == 1.0
    paid = where(evaluation, policy="random", agent=2)["fines"].to_numpy().mean()
    assert measures["agent_2/fines"].value == pytest.approx(paid)
    text = printed(comparison_table(evaluation, ""))
    assert "equality of incomes" in text or not measures["income_equality"].replicas
    assert "agent 2: fines, apples" in text
    assert "where one may bite" not in text, "undefined everywhere"
    assert {"fines", "violations", "own_bites", "institutions/in_force_0"} <= set(evaluation.column_names)


def test_the_run_keeps_them_and_the_training_curve_shows_them(whole):
    table = read_episodes(whole)
    assert table["fines"].to_numpy().sum() > 0
    assert table["violations"].to_numpy().max() > 0
    assert (whole / "evaluation" / "trained.parquet").exists()
    high, wide = imread(training_curve(whole, title="own")).shape[:2]
    assert high > wide, "four panels"


GOVERNED = replace(
    GAME,
    institutions=(
        Boundaries.drawn("0011..2\n0011..2\n00..333", bite_fine=1.0, step_fine=0.25),
        Monitoring(prob=0.5),
        GraduatedSanctions(),
        Tax(rate=0.5, period_steps=4),
    ),
)


@pytest.fixture(scope="module")
def governed(tmp_path_factory):
    """The recording of random agents in a game with cprl's own institutions."""
    folder = tmp_path_factory.mktemp("governed")
    recorded(folder, CommonsEnv(GOVERNED, 2, seed=1), replicas=2, episodes=3)
    return folder / "run.rrd"


def test_every_name_that_is_logged_of_institutions_is_in_the_docs(governed):
    text = (ROOT / "docs" / "metrics.md").read_text()
    logged = {name for name in entities(governed) if name.startswith("institutions/")}
    assert {"institutions/own_share_of_bites", "institutions/recidivism"} <= logged
    assert "institutions/unjust_share_of_tags" not in logged, "no Mediation"
    assert all(f"`{name}`" in text for name in logged)


def test_the_board_shows_whose_the_regions_are(governed):
    regions = [(owners, cells.sum()) for owners, cells in regions_of(GOVERNED)]
    assert regions == [([0], 6), ([1], 4), ([2], 2), ([3], 3)]
    strips = static(governed, "world/regions", "LineStrips2D:strips")
    # the sides of 3 x 2, 2 x 2, 2 x 1 and 1 x 3 cells, one line for each
    assert len(strips) == 10 + 8 + 6 + 8


def test_regions_that_several_agents_share_are_drawn_once():
    shared = Boundaries.drawn("aaaa...\naaaa...\nbbbb...", owners=("a", "a", "b", "ab"))
    game = replace(GAME, institutions=(shared,))
    assert [owners for owners, _ in regions_of(game)] == [[0, 1, 3], [2, 3]]


def test_decisions_have_the_names_of_their_ballots():
    env = CommonsEnv(replace(GAME, institutions=(Vote(on=Tax(), choices=(0.0, 0.5)), Sanctioner())), 1)
    curves = plotted_numbers(env, ("a", "b", "c", "d"), reported_by(env), episodes=1)
    assert curves.in_force == ("the tax rate", "who may fire")
