"""Games, boards and experiments draw themselves; the notebook of `examples` runs from the first cell on."""

from base64 import b64decode
from dataclasses import replace
from io import BytesIO
from xml.etree import ElementTree

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image
from places import ROOT

import cprl
from cprl import maps, presets
from cprl.algorithms import DQN
from cprl.commons.cells import APPLE, WASTE
from cprl.institutions import Quota
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.population import Learning, Scripted

NOTEBOOK = ROOT / "examples" / "notebook.ipynb"


def cells_of(html, board, colour):
    """In how many cells of a picture of a board a colour is."""
    png = b64decode(ElementTree.fromstring(html.replace(">", "/>")).get("src").partition(",")[2])
    picture = np.asarray(Image.open(BytesIO(png)))[1:, 1:]
    cells = picture.reshape(board.height, len(picture) // board.height, board.width, -1, 3)
    return (cells == colour).all(-1).any((1, 3)).sum()


def test_a_board_draws_its_apples_and_agents():
    board = maps.parse("A>A\n.#A\n^.A")
    html = board._repr_html_()
    assert cells_of(html, board, PALETTE[APPLE]) == 4
    assert [cells_of(html, board, agent_colour(agent)) for agent in (0, 1)] == [1, 1]
    cleanup = presets.game("ssd/cleanup-v1").map
    assert cells_of(cleanup._repr_html_(), cleanup, PALETTE[WASTE]) == len(cleanup.waste)


def test_a_game_and_an_experiment_say_what_they_are():
    game = presets.game("commons", variant="as_run")
    assert "Rules: none beyond the game." in game._repr_html_()
    learning = Learning(DQN(settings=presets.dqn_settings("commons")))
    agents = (learning, learning, Scripted("greedy"), Scripted("greedy"))
    game = cprl.Game(map=game.map, rules=game.rules, institutions=(Quota(share=0.25, window_steps=50),))
    experiment = cprl.Experiment(name="a<b", game=game, agents=agents, episodes=3, replicas=2, worlds=4)
    html = experiment._repr_html_()
    assert "of its own" not in html
    own = {"transforms": (cprl.Custom("laws:RichPay"),), "metrics": (cprl.Custom("fair:gap"),)}
    with_own = replace(experiment, **own)._repr_html_()
    assert "Rules: quota (share 0.25); laws:RichPay." in with_own
    assert "Code of its own: transforms: laws:RichPay; metrics: fair:gap." in with_own
    soft = replace(learning, algorithm=cprl.Custom("soft_q:SoftQ"))
    assert "by soft_q:SoftQ" in replace(experiment, agents=(soft,) * 4)._repr_html_()
    for part in ("<b>a&lt;b</b>: 2 agents by DQN", "2 replicas of 4 worlds", "quota (share 0.25", "<img"):
        assert part in html


def streams(notebook, name):
    """What the cells of a notebook write on a stream, one block of output after the other."""
    return [
        output.text
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "stream" and output.name == name
    ]


@pytest.mark.integration
def test_no_import_greets_in_a_notebook(tmp_path):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("import cprl\ncprl.run")])
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    assert streams(notebook, "stderr") == []


BAR = """
from cprl import CommonsEnv, Game, Rules, maps
from cprl.policies.actors import LaneActor
from cprl.terminal import progress
from cprl.training import Schedule, train

progress._NOTEBOOK_PERIOD_S = 0.0
game = Game(map=maps.parse(".A>\\n..A"), rules=Rules(window_rows=3, window_columns=3, episode_steps=5))
schedule = Schedule(episodes=9)
with progress.ProgressBar(schedule, game) as bar:
    walker = LaneActor(None, 8, seeds=[(0,)], agents=1)
    train(CommonsEnv(game, 1), {}, schedule, others={(0,): walker}, callbacks=[bar])
"""


@pytest.mark.integration
def test_a_bar_is_one_block_of_an_executed_notebook_and_shows_the_end(tmp_path):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(BAR)])
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output.data["text/plain"] for output in notebook.cells[0].outputs]
    (bar,) = [text for text in shown if "░" in text or "█" in text]
    assert bar == f"{'█' * 20} training: 9 episodes"


@pytest.mark.integration
def test_the_notebook_runs(tmp_path):
    notebook = nbformat.read(NOTEBOOK, 4)
    first = notebook.cells[1]
    assert "EPISODES = 300" in first.source
    first.source = first.source.replace("EPISODES = 300", "EPISODES = 1")
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [
        output.data.get("text/html", "")
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "execute_result"
    ]
    assert ["<img" in html for html in shown] == [True, True, False, False]
    assert ["<iframe" in html for html in shown] == [False, False, True, True]
    assert "A quota" in shown[2]
    assert streams(notebook, "stderr") == []
    assert not any("\r" in text or "steps/s" in text for text in streams(notebook, "stdout"))
    assert (tmp_path / "notebook" / "no_rule" / "report.html").is_file()
