"""Episodes of stored agents, side by side, as a GIF or an MP4."""

import csv
import subprocess
from dataclasses import replace
from functools import partial
from io import BytesIO
from itertools import pairwise
from unittest.mock import Mock

import minari
import numpy as np
import pytest
import torch
from drawings import frames_of
from imageio_ffmpeg import get_ffmpeg_exe
from matrix_games import stag_hunt
from PIL import Image
from stored_runs import CORRIDORS, command, stored

from cprl import Custom, Game, Rules, load, maps
from cprl.commons.cells import APPLE, GROUND
from cprl.evaluation.film import Style, film_episode, record_episode, titles_of
from cprl.evaluation.fresh import fresh_episodes
from cprl.experimental.export_turns import export_turns
from cprl.institutions import Monitoring, Quota
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.pictures.episode_picture import EpisodePicture
from cprl.pictures.image import EMPTY_SITE_COLOUR
from cprl.values import trusting

LEFT = [5, 3, 2, 0]
"""Apples on the board at the start and after each turn."""


MEADOW = Game(
    map=maps.parse("\n".join([".A.", "A>A", ".A.", "...", "^.<"])),
    rules=Rules(regrow_prob=(0.0, 0.5), window_rows=4, window_columns=3, episode_steps=12, freeze_steps=0),
)
"""A higher board, more agents and a longer clock than the corridors."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs on the corridors by the policy of both agents, and one on another board."""
    folder = tmp_path_factory.mktemp("runs")
    for policy in ("greedy", "random"):
        stored(folder / policy, policy=policy)
    stored(folder / "meadow", MEADOW, "random")
    return folder


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn from now on: the number of moments, the title and the words of each picture."""
    pictures, draw = [], EpisodePicture.draw

    def noted(picture, moments, title, **words):
        pictures.append((len(moments), title, words["end"], words["card"]))
        return draw(picture, moments, title, **words)

    monkeypatch.setattr(EpisodePicture, "draw", noted)
    return pictures


def sites_in(picture, game=CORRIDORS):
    """The colour in the middle of each site of a film of one run, [K, 3]."""
    seen = EpisodePicture(game.map, steps=9, width=picture.shape[1])
    boxes = [seen.cell_box(*site) for site in game.map.sites]
    return np.array([picture[int(box[1] + box[3]) // 2, int(box[0] + box[2]) // 2] for box in boxes])


def apples_in(picture):
    """How many cells of the board look like an apple."""
    return (sites_in(picture) == PALETTE[APPLE]).all(-1).sum()


def test_a_gif_shows_the_board_die_and_ends_with_a_card_of_two_seconds(runs, tmp_path, drawn):
    path, (played,) = film_episode(runs / "greedy", tmp_path / "film.gif", style=Style(width=300, fps=10))
    assert (played.steps, played.harvest.tolist(), played.stock_left) == (3, [2, 3], 0)
    pictures, durations = frames_of(path)
    assert [apples_in(picture) for picture in pictures[:-1]] == LEFT
    assert durations == [100, 100, 100, 100, 2000]
    for agent in range(2):
        assert (pictures[0] == agent_colour(agent)).all(-1).sum() > 400, "a cell of its colour"
    assert len(pictures[0]) < 600
    ends, cards = zip(*[words[2:] for words in drawn[-5:]], strict=True)
    assert ends == ("", "", "", *["gone for good at turn 3 of 9"] * 2)
    assert cards == ("", "", "", "", "5 apples picked · gone for good at turn 3 of 9")


def test_every_nth_turn_is_shown_and_always_the_last_and_sites_without_an_apple_are_dim(runs, tmp_path):
    path, _ = film_episode(runs / "greedy", tmp_path / "own.gif", style=Style(every=2, width=300))
    pictures, _ = frames_of(path)
    assert [apples_in(picture) for picture in pictures[:-1]] == [LEFT[0], LEFT[2], LEFT[3]]
    under_agents, dead = [(0, 3), (2, 1)], sites_in(pictures[2])
    empty = [dead[place] for place, site in enumerate(CORRIDORS.map.sites) if site not in under_agents]
    assert (np.array(empty) == EMPTY_SITE_COLOUR).all()
    assert np.array(EMPTY_SITE_COLOUR).sum() > 1.5 * np.array(PALETTE[GROUND]).sum()


def test_populations_play_side_by_side_on_one_clock_below_their_titles(runs, tmp_path, drawn):
    titles = ["Été", "quotas, 50 %"]
    path, played = film_episode(
        runs / "greedy",
        tmp_path / "both.gif",
        beside=[runs / "random"],
        style=Style(width=480, titles=titles),
    )
    assert [title for _, title, _, _ in drawn[-2:]] == titles
    assert [episode.steps for episode in played] == [3, 9]
    both, durations = frames_of(path)
    assert len(both) == 1 + 9 + 1
    assert durations[-1] == 2000
    left, right = both[:, :, :240], both[:, :, 240:]
    assert [apples_in(picture) for picture in left] == [*LEFT, *[0] * 6, 0]
    assert (left[3:-1] == left[3]).all(), "the dead board waits"
    assert all((now != before).any() for before, now in pairwise(right)), "the other plays"
    _, alone = film_episode(runs / "random", tmp_path / "alone.gif", style=Style(width=240))
    assert alone[0].harvest.tolist() == played[1].harvest.tolist(), "as it plays alone"


def test_boards_agents_and_clocks_may_differ_side_by_side(runs, tmp_path):
    path, played = film_episode(
        runs / "greedy", tmp_path / "film.mp4", beside=(runs / "meadow",), style=Style(width=500, fps=5)
    )
    assert [(episode.steps, len(episode.harvest)) for episode in played] == [(3, 2), (12, 3)]
    assert len(pictures_of(path, 500)) == 1 + 12 + 2 * 5


def test_titles_are_what_tells_runs_apart(runs, tmp_path):
    limits = Quota(fine=1.0), Monitoring(prob=0.5)
    governed = [
        stored(tmp_path / name, replace(CORRIDORS, institutions=institutions), name="two_rules")
        for name, institutions in (("one", ()), ("two", limits), ("three", limits))
    ]

    def titles(*names):
        return titles_of([fresh_episodes([name])[0] for name in names])

    assert titles(runs / "greedy") == ["Greedy"]
    assert titles(runs / "greedy", runs / "random") == ["Greedy", "Random"]
    assert titles(*governed[:2]) == ["No rule", "Quota and monitoring"]
    assert titles(*governed) == ["one", "two", "three"], "two have the same rules, all the same name"
    own = stored(
        tmp_path / "own",
        replace(CORRIDORS, institutions=limits),
        transforms=[Custom("own_parts:Gift", {"apples": 0.5})],
    )
    with trusting(["own_parts:Gift"]):
        assert titles(runs / "greedy", own) == ["No rule", "Quota and monitoring and gift"]


def test_the_film_is_the_episode_that_the_recording_has(runs, tmp_path):
    _, recorded = record_episode(runs / "random", tmp_path / "own.rrd", episode=3)
    _, (filmed,) = film_episode(
        runs / "random", tmp_path / "own.gif", episode=3, style=Style(every=9, width=240)
    )
    assert filmed.harvest.tolist() == recorded.harvest.tolist()
    assert filmed.metrics == pytest.approx(recorded.metrics, nan_ok=True)
    _, (other,) = film_episode(
        runs / "random", tmp_path / "other.gif", episode=4, style=Style(every=9, width=240)
    )
    assert other.metrics["sustainability"] != recorded.metrics["sustainability"]


def test_with_the_seed_of_an_evaluation_its_worlds_are_filmed(tmp_path):
    growing = replace(
        CORRIDORS,
        rules=replace(CORRIDORS.rules, regrow_prob=(0.0, 0.3), shuffle_starts=True, episode_steps=30),
    )
    run = stored(tmp_path / "own", growing, replicas=2)
    worlds = load(run).env(2 * 3, seed=77)
    stay = torch.full((6, 2), 6)

    def played(env, actions):
        moment = env.reset()
        for _ in range(25):
            moment = env.step_mdp(env.step(moment.set(("agents", "action"), actions)))
        return moment["agents", "observation"]

    of_evaluation = played(worlds, stay)
    for seed, is_same in ((77, True), (78, False)):
        (one,) = fresh_episodes([run], replica=1, episode=3 * 1 + 1, seed=seed)
        assert torch.equal(played(one.env, stay[:1])[0], of_evaluation[4]) is is_same


def pictures_of(path, wide):
    """The pictures of an MP4 of a width, [frames, height, width, 3]."""

    def read(*words):
        command = [get_ffmpeg_exe(), "-loglevel", "error", "-i", path, *words, "-"]
        return subprocess.run(command, check=True, capture_output=True).stdout

    first = Image.open(BytesIO(read("-frames:v", "1", "-c:v", "png", "-f", "image2pipe")))
    assert first.width == wide
    raw = read("-f", "rawvideo", "-pix_fmt", "rgb24")
    return np.frombuffer(raw, np.uint8).reshape(-1, first.height, wide, 3)


def test_an_mp4_without_imageio_ffmpeg_is_refused(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.evaluation.video_files.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="imageio-ffmpeg"):
        film_episode(runs / "greedy", tmp_path / "a.mp4")


@pytest.mark.parametrize("name", ["own.gif", "own.mp4", "own.rrd"])
def test_a_film_that_is_interrupted_leaves_no_file_and_can_be_made_again(runs, tmp_path, monkeypatch, name):
    make = record_episode if name.endswith(".rrd") else partial(film_episode, style=Style(width=240))
    draw, drawn = EpisodePicture.draw, []

    def interrupted(*arguments, **named):
        drawn.append(arguments)
        if len(drawn) == 6 or make is record_episode:
            raise KeyboardInterrupt
        return draw(*arguments, **named)

    with monkeypatch.context() as patch:
        patch.setattr(EpisodePicture, "draw", interrupted)
        patch.setattr("cprl.evaluation.film.events", interrupted)
        with pytest.raises(KeyboardInterrupt):
            make(runs / "random", tmp_path / name)
    assert list(tmp_path.iterdir()) == []
    path, _ = make(runs / "random", tmp_path / name)
    with pytest.raises(FileExistsError, match=rf"{name} exists and is not overwritten"):
        make(runs / "random", path)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--out", "own.avi"], r"--out is own\.avi"),
        (["--fps", "3"], "--fps is for films"),
        (["--every", "3", "--out", "own.rrd"], r"--every is for films"),
        (["--out", "own.gif", "--every", "0"], "every is 0"),
        (["--out", "own.gif", "--fps", "51"], r"fps is 51\.0"),
        (["--out", "own.gif", "--width", "5000"], "width is 5000"),
        (["--out", "there.gif"], r"there\.gif exists and is not overwritten"),
        (["--out", "own.gif", "--replica", "4"], "replica is 4"),
        (["--beside", "{random}"], "--beside is for films"),
        (["--out", "own.gif", "--beside", "{meadow}", "gone"], "gone"),
        (["--out", "own.gif", "--beside", "{meadow}", "--titles", "One"], "titles is"),
        (["--out", "own.gif", "--titles", "One\nand more"], "titles is"),
        (["--out", "own.gif", "--beside", "{meadow}", "--width", "479"], "width is 479"),
        (["--out", "own.gif", "--beside", *["{random}"] * 8], "beside is"),
    ],
)
def test_what_cannot_be_filmed_is_refused_before_anything_is_played(
    runs, tmp_path, monkeypatch, capsys, words, said
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.gif").touch()
    for module in ("film", "fresh"):
        monkeypatch.setattr(f"cprl.evaluation.{module}.turns", lambda *_: pytest.fail("played"))
    words = [word.format(random=runs / "random", meadow=runs / "meadow") for word in words]
    with pytest.raises(SystemExit, match=said):
        command(monkeypatch, capsys, "film", runs / "random", *words)
    assert [path.name for path in tmp_path.iterdir()] == ["there.gif"]


@pytest.mark.integration
def test_the_command_says_what_it_wrote(runs, tmp_path, monkeypatch, capsys):
    filmed = partial(command, monkeypatch, capsys, "film", runs / "greedy", "--out")
    assert filmed(tmp_path / "own.gif", "--width", 240).splitlines()[:2] == [
        "Replica 0, episode 0.",
        "3 steps, apples: 2, 3; 0 left",
    ]
    told = filmed(tmp_path / "both.gif", "--beside", runs / "meadow", "--width", 480)
    *which, first, second, _ = told.splitlines()
    assert which == [f"{runs / name}: Replica 0, episode 0." for name in ("greedy", "meadow")]
    assert first == f"{runs / 'greedy'}: 3 steps, apples: 2, 3; 0 left"
    assert second.startswith(f"{runs / 'meadow'}: 12 steps")


def test_boards_that_are_larger_than_the_picture_are_drawn_smaller():
    wide = maps.random(6, 300, agents=14, density=0.2, clustering=0.5, seed=1)
    picture = EpisodePicture(wide, steps=10, width=240)
    assert picture.size[0] == 240
    assert picture._board_size[0] <= 240
    for height in (30, 300, 9000):
        picture = EpisodePicture(maps.parse("\n".join(["A>", *["A."] * (height - 1)])), steps=10, width=240)
        assert picture._board_size[1] <= 480
        assert picture.size[1] < 1000, "a GIF holds at most 65,535 rows"


def test_fresh_episodes_are_written_as_csv(runs, tmp_path, monkeypatch, capsys):
    path = tmp_path / "deep" / "episodes.csv"
    words = ["export", runs / "greedy", path, "--format", "csv", "--episodes", "2"]
    said = command(monkeypatch, capsys, *words)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert said == f"wrote {path}, {len(rows)} rows\n"
    episode = record_episode(runs / "greedy", tmp_path / "film.rrd", episode=1)[1]
    second = [row for row in rows if row["episode"] == "1"]
    assert len(second) == episode.steps * 2
    harvest = [sum(float(row["harvest"]) for row in second if row["agent"] == agent) for agent in "01"]
    assert harvest == episode.harvest.tolist()
    assert {row["action"] for row in rows} <= set(CORRIDORS.actions)
    with pytest.raises(FileExistsError):
        export_turns(runs / "greedy", path)
    trained = load(runs / "greedy").experiment.seed
    with pytest.raises(ValueError, match=f"seed is {trained}, the training seed"):
        export_turns(runs / "greedy", tmp_path / "new.csv", seed=trained)
    assert not (tmp_path / "new.csv").exists()


@pytest.mark.parametrize("flag", ["--episodes 3", "--replica 1", "--seed 5", "--format csv --no-weights"])
def test_flags_of_another_format_are_refused_by_name(flag, runs, tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit, match=f"{flag.split()[-1 if 'no' in flag else 0]} is of"):
        command(monkeypatch, capsys, "export", runs / "greedy", tmp_path / "new", *flag.split())
    assert not (tmp_path / "new").exists()


def test_episodes_of_a_matrix_game_are_written_as_csv_with_actions_by_number(tmp_path):
    with trusting(["matrix_games:MatrixGame"]):
        export_turns(stored(tmp_path / "run", stag_hunt(turns=3), "random"), tmp_path / "episodes.csv")
    rows = list(csv.DictReader((tmp_path / "episodes.csv").read_text().splitlines()))
    assert [row["turn"] for row in rows[:6]] == ["1", "1", "2", "2", "3", "3"]
    assert {row["action"] for row in rows} <= {"0", "1"}
    assert not {"row", "stock", "fines"} & {*rows[0]}, "what the game does not have"


def test_a_csv_has_places_headings_stock_and_what_institutions_take_and_give(tmp_path):
    governed = replace(
        CORRIDORS, institutions=(Quota(share=0.0, window_steps=2, fine=1.0), Monitoring(prob=1.0))
    )
    path = tmp_path / "episodes.csv"
    export_turns(stored(tmp_path / "run", governed), path, episodes=1)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    # Agent 0 begins at row 0, column 0 and walks right; agent 1 at row 2, column 4 and walks left.
    turns = [[row for row in rows if row["agent"] == agent] for agent in "01"]
    assert [(row["row"], row["column"], row["heading"]) for row in turns[0][:3]] == [
        ("0", str(column), "right") for column in (1, 2, 3)
    ]
    assert [(row["row"], row["column"], row["heading"]) for row in turns[1][:3]] == [
        ("2", str(column), "left") for column in (3, 2, 1)
    ]
    assert [row["stock"] for row in turns[0][:3]] == [str(left) for left in LEFT[1:]]
    assert sum(float(row["fines"]) for row in rows) == 5, "an apple each"
    assert {row["transfers"] for row in rows} == {"0.0"}


def test_an_export_that_is_interrupted_leaves_no_file(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.evaluation.fresh.turns", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        export_turns(runs / "greedy", tmp_path / "episodes.csv")
    assert not [*tmp_path.iterdir()]


def test_fresh_episodes_are_written_as_minari_data_sets(runs, tmp_path, monkeypatch):
    written = export_turns(runs / "random", tmp_path / "random", format="minari", episodes=2)
    assert written == [tmp_path / "random" / f"agent_{agent}-v0" for agent in range(2)]
    export_turns(runs / "random", tmp_path / "episodes.csv", episodes=2)
    rows = list(csv.DictReader((tmp_path / "episodes.csv").read_text().splitlines()))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    for agent in range(2):
        read = minari.load_dataset(f"random/agent_{agent}-v0")
        of_agent = [row for row in rows if row["agent"] == str(agent)]
        assert (read.total_episodes, read.total_steps) == (2, len(of_agent))
        assert read.observation_space.shape == CORRIDORS.observation_shape
        episodes = list(read.iterate_episodes())
        actions = [CORRIDORS.actions[action] for one in episodes for action in one.actions]
        assert actions == [row["action"] for row in of_agent]
        assert [float(reward) for one in episodes for reward in one.rewards] == [
            float(row["reward"]) for row in of_agent
        ]
        for one in episodes:
            assert (one.terminations | one.truncations).tolist() == [False] * (len(one.actions) - 1) + [True]
            assert one.infos["joint_action"][1:, agent].tolist() == one.actions.tolist()
            assert len(one.observations) == len(one.actions) + 1


def test_a_film_of_a_board_that_lives_says_what_is_left(runs, tmp_path, drawn):
    _, (played,) = film_episode(runs / "meadow", tmp_path / "film.gif", style=Style(width=240))
    apples = int(played.harvest.sum())
    picked = f"{apples} apple{'s'[: apples != 1]} picked"
    assert drawn[-1][2:] == ("", f"{picked} · {played.stock_left} of 4 still on the board")


def test_an_mp4_has_a_picture_for_each_turn_and_holds_the_card(runs, tmp_path):
    path, _ = film_episode(runs / "greedy", tmp_path / "own.mp4", style=Style(width=240, fps=5))
    pictures = pictures_of(path, 240)
    assert len(pictures) == len(LEFT) + 2 * 5, "two seconds"
    greens = [(np.abs(picture.astype(int) - PALETTE[APPLE]) < 30).all(-1).sum() for picture in pictures]
    assert greens[0] > 2 * greens[3] > 0, "the area of the plot is left"


def test_from_the_first_picture_on_a_line_says_what_the_episode_comes_to(runs, tmp_path, monkeypatch):
    said, draw = [], EpisodePicture.draw

    def noted(picture, moments, title, **words):
        said.append((len(moments), words["headline"]))
        return draw(picture, moments, title, **words)

    monkeypatch.setattr(EpisodePicture, "draw", noted)
    film_episode(runs / "greedy", tmp_path / "film.gif", style=Style(width=240))
    assert said[0][0] == 1, "the board as it begins"
    assert {words for _, words in said} == {"This episode: 5 apples picked, gone for good at turn 3 of 9"}


def test_the_axis_of_harvests_ends_at_the_largest():
    picture = EpisodePicture(CORRIDORS.map, steps=9, width=240, most_harvested=3)
    top = min(row for _, row in picture._points(0, np.array([0, 1, 3]), 3))
    assert top == picture._axes_top
