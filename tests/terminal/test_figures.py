"""Figures: everything drawn is in the legend, which lies beside the data."""

import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import published_figures as reported
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from drawings import CORNERS, see_that_it_can_be_read, society
from iql import IQL
from matplotlib.collections import PolyCollection
from matplotlib.image import imread
from matplotlib.text import Text
from PIL import Image
from published import published_experiment
from published_figures import on_white
from random_play import random_returns
from results import Result
from written_episodes import an_episode

import cprl
from cprl import Game, Rules, maps, presets
from cprl.algorithms import DQN, MADDPG, PPO, PR2, SAC
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.measuring.windows import running_mean
from cprl.population import Learning, Scripted, Team, exploration_steps
from cprl.runs.curves import episode_of_turn
from cprl.runs.episodes import table_of
from cprl.terminal import style
from cprl.terminal.figures import training_curve


@pytest.fixture(autouse=True)
def little_random_play(monkeypatch):
    """Its mean is a line of the figures, which is not looked at."""
    monkeypatch.setattr(reported, "random_returns", partial(random_returns, episodes=10))


def a_run(folder, metrics):
    """A run of two agents who share what is harvested; metrics are [R, E] by name."""
    replicas, episodes = next(iter(metrics.values())).shape
    shape = replicas, episodes, 2
    replica, episode, agent = (axis.ravel() for axis in np.indices(shape))
    columns = {"replica": replica, "episode": episode, "agent": agent}
    columns |= {name: np.repeat(values.ravel(), 2) for name, values in metrics.items()}
    if "survival_steps" in metrics:
        columns["steps"] = np.repeat(np.round(metrics["survival_steps"].ravel()).astype(np.int32), 2)
    columns["return"] = np.repeat(metrics["collective_return"].ravel() / 2, 2)
    columns["terminated"] = np.ones(replica.size, bool)
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), folder / "episodes.parquet")
    return folder


def the_tragedy(replicas, episodes):
    """The course of `society`, in so many episodes."""
    course = society(replicas, 0.05)
    at = np.linspace(0, CORNERS[-1], episodes).astype(int)
    return {name: curves[:, at] for name, curves in course.items()}


def labels(figure):
    (legend,) = figure.subfigs[0].legends
    return [text.get_text().replace("\n", " ") for text in legend.get_texts()]


def curves_panels(figure):
    return [axes for axes in figure.axes if axes.get_ylabel()]


def see_that_the_legend_is_whole(figure):
    """Each line and each interval has the look of an entry; no legend touches a panel."""
    figure.draw_without_rendering()
    (legend,) = figure.subfigs[0].legends
    looks = {handle.get_color() for handle in legend.legend_handles if hasattr(handle, "get_color")}
    looks |= {tuple(np.round(handle.get_facecolor(), 3)) for handle in legend.get_patches()}
    for axes in curves_panels(figure):
        boundaries = [line for line in axes.lines if line.get_color() == "#999999"]  # of bands of phases
        for line in set(axes.lines) - set(boundaries):
            assert line.get_color() in looks
        for collection in axes.collections:
            if isinstance(collection, PolyCollection):
                assert tuple(np.round(collection.get_facecolor()[0], 3)) in looks
        for patch in axes.patches:
            assert tuple(np.round(patch.get_facecolor(), 3)) in looks
        assert not legend.get_window_extent().overlaps(axes.get_window_extent())


def test_a_short_training_shows_its_peak_its_end_random_play_and_where_exploration_ends(tmp_path, drawn):
    run = a_run(tmp_path / "run", the_tragedy(4, 200))
    random = table_of([an_episode(0, collective_return=282.0, survival_steps=1000.0)])
    training_curve(run, title="commons", random=random, exploration_turns=50_000)
    (figure,) = drawn
    above, below = curves_panels(figure)
    assert (above.get_ylabel(), below.get_ylabel()) == ("collective return, apples", "survival, steps")
    assert (above.get_ylim()[0], below.get_ylim()[0]) == (0, 0)
    told = " / ".join(labels(figure))
    for words in (
        "each episode, mean of the replicas",
        "each replica, running mean",
        "mean of the 4 replicas, running mean",
        "random play, 282 apples, 1,000 steps",
        "highest mean of 10 episodes, 5",
        "last mean of 10 episodes, 4",
        "exploration ends, episode 5",
    ):
        assert words in told
    assert figure.caption == "Running means are over 10 episodes, centred."
    see_that_the_legend_is_whole(figure)
    levels = [line for line in above.lines if line.get_color() == style.RANDOM_LINE["color"]]
    assert [(line.get_linestyle(), line.get_ydata()[0]) for line in levels] == [("--", 282.0)]


def test_a_centred_running_mean_stands_at_the_middle_of_its_episodes(tmp_path, drawn):
    metrics = the_tragedy(1, 60)
    metrics["collective_return"] = np.arange(60.0)[None]
    training_curve(a_run(tmp_path / "run", metrics), title="a line")
    bold = next(line for line in curves_panels(drawn[0])[0].lines if line.get_color() == style.MEAN)
    assert "highest and last mean of 3 episodes, 58 apples, episode 58" in labels(drawn[0])
    np.testing.assert_allclose(bold.get_xdata(), bold.get_ydata(), err_msg="a mean of a line lies on it")
    assert running_mean(np.arange(5.0), 2).tolist() == [0.5, 1.5, 2.5, 3.5]


def test_a_running_mean_of_many_worlds_counts_each_world_alike(tmp_path, drawn):
    worlds = np.array([*[0, 1, 2, 3] * 10, *[0, 1, 2] * 20])  # the fourth plays a long episode at the end
    metrics = the_tragedy(1, 100)
    metrics["collective_return"] = np.where(worlds == 3, 400.0, 100.0)[None]
    run = a_run(tmp_path / "run", metrics)
    table = pq.read_table(run / "episodes.parquet").append_column("world", pa.array(np.repeat(worlds, 2)))
    pq.write_table(table, run / "episodes.parquet")
    training_curve(run, title="four worlds")
    assert "last mean of 8 episodes, 175 apples" in " / ".join(labels(drawn[0]))
    assert drawn[0].caption == "Running means are over 8 episodes, centred, 2 of each of 4 worlds."


def test_what_is_not_over_by_the_last_episode_is_said(tmp_path, drawn):
    training_curve(a_run(tmp_path / "run", the_tragedy(2, 40)), title="short", exploration_turns=10**6)
    assert "exploration ends" not in " ".join(labels(drawn[0]))
    assert drawn[0].caption.endswith("Exploration was not over at the last episode.")


def test_exploration_ends_with_the_last_agents_epsilon():
    def dqn(hold, decay, **more):
        settings = DQNSettings(epsilon_hold_steps=hold, epsilon_decay_steps=decay, **more)
        return Learning(DQN(settings=settings))

    assert exploration_steps([dqn(800, 1000), Scripted(), dqn(0, 2000)]) == 2000
    assert exploration_steps([Learning(PPO(settings=RolloutSettings())), Scripted()]) is None
    assert exploration_steps([dqn(0, 10, epsilon_start=0.1, epsilon_end=0.1)]) is None, "it never falls"
    policies = [Learning(kind(settings=DQNSettings())) for kind in (SAC, IQL, PR2)]
    team = Team(MADDPG(settings=DQNSettings()), agents=(3, 4))
    assert exploration_steps([*policies, team]) is None, "they draw from their policies"
    assert exploration_steps([*policies, dqn(0, 70)]) == 70
    columns = {"replica": [0, 0, 0, 1, 1, 1], "agent": [0] * 6, "steps": [10, 10, 10, 5, 5, 20]}
    assert episode_of_turn(pa.table(columns), 20) == 1.5, "in the second and in the third episode"
    assert episode_of_turn(pa.table(columns), 31) is None
    side_by_side = pa.table({**columns, "world": [0, 1, 0, 2, 3, 3]})
    assert episode_of_turn(side_by_side, 20) == 2, "in the third of both, after 20 and after 25 turns"
    assert episode_of_turn(side_by_side, 10) == 1


def test_a_game_without_a_harvest_has_one_panel_and_an_agents_colour_has_an_edge(tmp_path, drawn):
    metrics = the_tragedy(1, 30)
    table = a_run(tmp_path / "run", metrics)
    rows = pq.read_table(table / "episodes.parquet").drop(["collective_return", "equality", "peacefulness"])
    pq.write_table(rows, table / "episodes.parquet")
    training_curve(table, title="matrix")
    assert [axes.get_ylabel() for axes in drawn[0].axes] == ["income of all agents together"]
    assert len(on_white(2)["path_effects"]) == 2
    assert on_white(0)["linestyle"] != on_white(4)["linestyle"], "its colour may be the same"


def a_line(path, title="a line", name="a line", **look):
    """A figure of one line, and who drew it."""
    with style.drawing(path, **look) as sheet:
        (axes,) = sheet.panels(1, high=12)
        axes.plot([1, 2], label=name)
        axes.set_xticks([0, 1], [name, "other"])
        sheet.title, sheet.caption = title, "Made up, here and now."
    return sheet.figure


@pytest.mark.parametrize(("width", "pixels", "dots"), [("page", 1200, 150), ("column", 990, 300)])
def test_a_figure_is_as_wide_as_a_page_or_a_column_and_a_long_title_wraps(width, pixels, dots, tmp_path):
    figure = a_line(tmp_path / "new" / "a.png", title="a title of many words " * 8, width=width)
    with Image.open(tmp_path / "new" / "a.png") as picture:
        assert (picture.width, round(picture.info["dpi"][0])) == (pixels, dots)
        assert picture.text["Description"] == "Made up, here and now."
    picture = imread(tmp_path / "new" / "a.png")
    assert all(edge.min() == 1 for edge in (picture[:, 0], picture[:, -1])), "nothing reaches over the edge"
    texts = [text.get_text() for text in figure.texts]
    assert texts[0].count("\n") > 0
    captions = {path.name: path.read_text() for path in (tmp_path / "new").glob("*.txt")}
    if width == "page":
        assert (texts[1], captions) == ("Made up, here and now.", {})
    else:
        assert texts[1:] == []
        assert captions["a.caption.txt"].endswith("\n\nMade up, here and now.\n")


@pytest.mark.integration
def test_the_suffix_says_what_is_written_the_same_each_time(tmp_path):
    for suffix, head in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        contents = []
        for name in ("a", "b"):
            a_line(tmp_path / f"{name}{suffix}")
            contents.append((tmp_path / f"{name}{suffix}").read_bytes())
        assert contents[0].startswith(head)
        assert contents[0] == contents[1]
    for path, look in (("a.jpg", {}), ("a.png", {"is_new": True}), ("b.png", {"width": "poster"})):
        with pytest.raises((ValueError, FileExistsError), match=r"path is|a\.png|width is"):
            a_line(tmp_path / path, **look)


def test_every_id_in_an_svg_stands_once(tmp_path):
    with style.drawing(tmp_path / "a.svg") as sheet:
        for axes in sheet.panels(4, columns=2, high=10):
            axes.plot([1, 2])
    ids = re.findall(r' id="([^"]*)"', (tmp_path / "a.svg").read_text())
    assert len(ids) == len(set(ids))
    assert not [one for one in ids if one[0].isdigit()], "which no name in XML begins with"


@pytest.mark.parametrize("name", ["pay_$1_or_$_", "$a$", r"\$5"])
def test_names_in_figures_are_no_formulas(name, tmp_path):
    figure = a_line(tmp_path / "a.png", title=name, name=name)
    texts = [text for text in figure.findobj(Text) if text.get_text() == name]
    assert len(texts) >= 3, "the title, the tick and the legend"
    assert not any(text.get_parse_math() for text in texts)


@pytest.mark.integration
@pytest.mark.parametrize("width", ["page", "column"])
def test_a_training_curve_can_be_read_at_every_width(width, tmp_path, drawn):
    run = a_run(tmp_path / "run", the_tragedy(4, 1200))
    random = table_of([an_episode(0, collective_return=282.0, survival_steps=1000.0)])
    training_curve(run, title="commons", random=random, exploration_turns=50_000, width=width)
    see_that_it_can_be_read(drawn[0], style.WIDTH_IN[width])


@pytest.mark.integration
@pytest.mark.parametrize("colours", [style.PNG_COLOURS, style.PNG_SHADES])
def test_a_figure_of_few_colours_looks_like_one_with_all_in_half_the_room(colours, tmp_path):
    with style.drawing(tmp_path / "few.png", colours=colours) as sheet:
        (axes,) = sheet.panels(1, high=24)
        sheet.figure.colorbar(axes.imshow(np.linspace(-1, 1, 900).reshape(30, 30), cmap="RdBu"))
    style.save(sheet.figure, tmp_path / "few.png", colours=colours)  # the first one still moves the bar
    sheet.figure.savefig(tmp_path / "all.png")
    with Image.open(tmp_path / "few.png") as picture:
        assert len(picture.getcolors()) <= colours
    drawn, few = (imread(tmp_path / name)[..., :3] for name in ("all.png", "few.png"))
    assert np.abs(drawn - few).max() < 20 / 255
    assert np.abs(drawn - few).mean() < 2 / 255
    assert (tmp_path / "few.png").stat().st_size < (tmp_path / "all.png").stat().st_size / 2


def a_result(name, recipe, level, *, agents=()):
    study = published_experiment(recipe)
    rng = np.random.default_rng(0)
    curves = {metric: level + rng.normal(0, 5, (3, 300)) for metric in study.curves}
    curves["survival_steps"] = np.full((3, 300), 500.0)
    game = presets.game(recipe if recipe != "two_against_random" else "two_complex", variant="as_run")
    specs = agents or (Learning(DQN(settings=DQNSettings(epsilon_decay_steps=50_000))),)
    return Result(
        paths=[Path(name)],
        recipe={"recipe": recipe},
        experiment=SimpleNamespace(game=game, agents=specs),
        report={},
        curves=curves,
        study=study,
    )


@pytest.mark.integration
def test_figures_that_are_compared_have_the_same_vertical_range(tmp_path, drawn):
    results = [
        a_result("a", "single_basic", 100.0),
        a_result("b", "single_complex", 900.0),
        a_result("c", "commons", 500.0),
    ]
    told = list(reported.draw_figures(results, tmp_path))
    limits = {
        (result.name, metric): curves_panels(figure)[0].get_ylim()
        for (result, metric, _), figure in zip(told, drawn, strict=True)
    }
    assert limits["a", "collective_return"] == limits["b", "collective_return"]
    assert limits["a", "collective_return"][1] > 900, "as high as the highest"
    assert limits["c", "collective_return"] != limits["a", "collective_return"], "of another board"


@pytest.mark.integration
def test_a_figure_beside_the_published_curve_says_how_both_are_smoothed(tmp_path, drawn):
    _, _, path = next(reported.draw_figures([a_result("a", "commons", 500.0)], tmp_path))
    assert path == tmp_path / "a_collective_return.png"
    assert drawn[0].caption.endswith(". Running means over the 30 episodes that follow.")
    told = labels(drawn[0])
    assert told[:4] == ["ours, each replica", "ours, 95 % interval", "ours, mean of 3 replicas", "published"]
    assert "exploration ends, episode 101" in told
    assert "phase: tragedy" in told, "of the published strip; 300 episodes have no phases of their own"
    see_that_the_legend_is_whole(drawn[0])


def test_one_replica_has_no_interval_and_an_experiment_of_ones_own_no_published_curve(tmp_path, drawn):
    result = a_result("a", "commons", 500.0)
    result.study = None
    result.curves = {name: values[:1] for name, values in result.curves.items()}
    (path,) = [path for _, _, path in reported.draw_figures([result], tmp_path)]
    assert path.name == "a_collective_return.png"
    assert labels(drawn[0]) == ["ours, one replica", "exploration ends, episode 101"]
    assert drawn[0].caption.endswith(". Running means over the 100 episodes that follow.")
    see_that_the_legend_is_whole(drawn[0])


def test_a_run_marks_where_the_exploration_of_its_agents_ends(tmp_path, drawn, curves):
    settings = DQNSettings(epsilon_hold_steps=3, epsilon_decay_steps=12, learning_starts=2, hidden_cells=(2,))
    experiment = cprl.Experiment(
        name="meadow",
        game=Game(
            map=maps.parse(".A>.A\n..<.A"), rules=Rules(episode_steps=5, window_rows=3, window_columns=3)
        ),
        agents=(Learning(DQN(settings=settings)), Scripted()),
        episodes=5,
        evaluation_episodes=1,
        engine="eager",
    )
    cprl.run(experiment, tmp_path / "run", watch="off")
    assert "exploration ends, episode 2" in labels(drawn[0])


def test_long_names_break_at_their_signs_and_only_where_they_must():
    assert style.wrapped("target_every_episodes", 8) == "target_every_\nepisodes"
    assert style.wrapped("beside a target_network", 10) == "beside a\ntarget_network"
