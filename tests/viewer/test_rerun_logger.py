"""Recordings are written for real and read back by Rerun's own reader."""

import re
import warnings
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np
import pytest
import rerun as rr
import torch
from corridor import Corridor
from live_viewers import listens, wait
from recordings import GAME, SCENE, column, frames, static, watched_training
from rerun.chunk import RrdReader
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, TransformedEnv
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss
from torchrl.record import VideoRecorder
from torchrl.trainers import LogScalar, LogValidationReward, Trainer

from cprl import CommonsEnv, Observation
from cprl.commons.cells import APPLE, BEAM, CLASS_COLOURS, FIRST_AGENT, GROUND, OTHER, SELF, WALL
from cprl.pictures.colours import PALETTE
from cprl.pictures.decoding import UNSEEN, classes_seen
from cprl.viewer.board import boards, mosaic
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import EMPTY_SITE
from cprl.viewer.scene import Scene, windows_of

pytestmark = pytest.mark.usefixtures("strict_rerun")


def test_numbers_are_read_back_under_their_names_with_all_three_timelines(tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        for episode, value in enumerate([0.5, float("nan"), 0.75]):
            logger.set_time(step=100 * episode, episode=episode)
            logger.log_scalar("social/equality", value)
            logger.log_scalar("agent_0/loss", torch.tensor(value), step=100 * episode + 1)
    steps, values = column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars")
    assert steps == [0, 100, 200]
    assert np.allclose([value[0] for value in values], [0.5, np.nan, 0.75], equal_nan=True)
    assert column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars", "episode")[0] == [0, 1, 2]
    assert column(tmp_path / "run.rrd", "social/equality", "Scalars:scalars", "frame")[0] == [0, 0, 0]
    assert column(tmp_path / "run.rrd", "agent_0/loss", "Scalars:scalars")[0] == [1, 101, 201]


def test_frames_show_the_board_the_agents_and_what_each_sees(tmp_path):
    taken, shown = frames(6, first_step=40)
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        logger.log_frames(taken)
    path = tmp_path / "run.rrd"
    steps, boards = column(path, "world/board", "SegmentationImage:buffer")
    assert steps == [40, 41, 42, 43, 44, 45]
    assert column(path, "world/board", "SegmentationImage:buffer", "frame")[0] == [0, 1, 2, 3, 4, 5]
    assert column(path, "world/board", "SegmentationImage:buffer", "episode")[0] == [7] * 6
    for frame, board in zip(shown, boards, strict=True):
        seen = np.array(board[0], np.uint8).reshape(5, 7)
        assert (seen[0] == WALL).all()
        inner, agents = seen[1:-1, 1:-1], {(int(frame.row[0]), int(frame.col[0])): FIRST_AGENT}
        if frame.in_play[1]:
            agents[int(frame.row[1]), int(frame.col[1])] = FIRST_AGENT + 1
        for site, apple in zip(GAME.map.sites, frame.stock, strict=True):
            assert site in agents or inner[site] == (APPLE if apple else EMPTY_SITE)
        assert {cell: inner[cell] for cell in agents} == agents
        others = (inner >= FIRST_AGENT) & (inner != EMPTY_SITE)
        assert others.sum() == len(agents), "who is out of play is not drawn as if it were in"
    _, lines = column(path, "world/agents", "LineStrips2D:strips")
    assert [len(drawn) for drawn in lines] == [4, 4, 2, 2, 2, 2], "a triangle and a digit an agent in play"
    (_, tip, *_), digit, *_ = (np.array(line) for line in lines[1])
    assert (tip - (2.5, 1.5)).tolist() == pytest.approx([0.44, 0], abs=1e-6), "heading 1 points right"
    assert (np.abs(digit - (2.5, 1.5)) < 0.5).all(), "the number is inside the cell"
    assert digit[:, 0].max() < tip[0] - 0.2, "and behind the triangle"
    _, windows = column(path, "windows", "SegmentationImage:buffer")
    _, (top, left) = windows_of(2, (3, 5)).corners
    first = np.array(windows[0][0], np.uint8).reshape(3 + top, 5 + left)
    assert np.array_equal(np.array(CLASS_COLOURS)[first[:3, :5]].transpose(2, 0, 1), shown[0].windows[0])
    assert np.array_equal(np.array(CLASS_COLOURS)[first[top:, left:]].transpose(2, 0, 1), shown[0].windows[1])
    assert UNSEEN in first
    frames_of_windows = static(path, "windows/frames", "Boxes2D:colors")
    assert [colour >> 8 for colour in frames_of_windows] == [0x56B4E9, 0xE66100], "the agents' colours"


def test_beams_and_those_out_of_play_have_marks_that_are_told_when_they_change(tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        logger.log_frames(frames(6)[0])
    path = tmp_path / "run.rrd"
    steps, beams = column(path, "world/beams", "Points2D:positions")
    assert steps == [1, 3, 5], "a beam over no cell, over one from frame 2 on, over two from frame 4 on"
    assert beams == [[], [[1.5, 1.5]], [[1.5, 1.5], [2.5, 1.5]]], "a dot in the middle of each cell"
    steps, labels = column(path, "world/out", "Boxes2D:labels")
    assert steps == [1, 3, 4, 5, 6]
    assert labels == [[], ["out"], ["out"], ["by 0"], ["by 0"]]
    _, centres = column(path, "world/out", "Boxes2D:centers")
    assert centres[1] == [[4 + 1.5, 2 + 1.5]]
    _, colours = column(path, "world/out", "Boxes2D:colors")
    assert colours[1][0] >> 8 == 0xE66100, "in agent 1's own colour"


def test_what_is_logged_together_is_sent_together(tmp_path):
    """A header that is sent with the next episode's first number is old when it is read."""
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        (stream,) = logger._streams
        stream.period_s = 0.0
        logger.log_scalar("alone", 1.0)
        assert not stream.buffer
        logger.log_lines("first", [1.0])
        logger.log_header("# Episode 1")
        assert list(stream.buffer) == ["first", "header"]
        logger.send_due()
        assert not stream.buffer


def test_colours_and_names_of_classes_are_in_the_recording(tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE):
        pass
    for entity, apple in (("", PALETTE[APPLE]), ("windows", CLASS_COLOURS[APPLE])):
        context = static(tmp_path / "run.rrd", entity, "AnnotationContext:context")
        told = {entry["class_id"]: entry["class_description"]["info"] for entry in context[0]}
        assert told[APPLE]["label"] == "apple"
        red, green, blue = apple
        assert told[APPLE]["color"] >> 8 == red << 16 | green << 8 | blue, "windows keep the study's colours"
    assert static(tmp_path / "run.rrd", "agent_1/return", "SeriesLines:names") == ["episodes", "agent_1"]
    assert RrdReader(tmp_path / "run.rrd").blueprints()


def test_torchrls_logger_interface_is_there(tmp_path):
    clip = torch.arange(2 * 3 * 4 * 5).reshape(1, 2, 3, 4, 5).to(torch.uint8)
    with RerunLogger("run", tmp_path) as logger:
        nested = TensorDict({"train": {"loss": torch.tensor(2.0)}}, [])
        logger.log_metrics(nested, step=5)
        logger.log_metrics({"q": torch.tensor([1.0, 3.0])}, step=5)
        logger.log_video("clip", clip, step=10)
        logger.log_histogram("weights", torch.tensor([0.0, 0.0, 1.0]), bins=2, step=6)
        logger.log_hparams({"gamma": 0.995})
        logger.log_text("an apple fell")
        assert "run.rrd" in repr(logger)
    path = tmp_path / "run.rrd"
    assert column(path, "train/loss", "Scalars:scalars") == ([5], [[2.0]])
    assert [column(path, f"q/{i}", "Scalars:scalars") for i in (0, 1)] == [([5], [[1.0]]), ([5], [[3.0]])]
    steps, images = column(path, "clip", "Image:buffer")
    assert steps == [10, 11]
    assert np.array_equal(np.array(images[1][0]).reshape(4, 5, 3), clip[0, 1].permute(1, 2, 0))
    assert column(path, "weights", "BarChart:values")[0] == [6]
    assert "| gamma | 0.995 |" in static(path, "recipe", "TextDocument:text")[0]
    assert column(path, "log", "TextLog:text")[1] == [["an apple fell"]]


def test_no_image_comes_before_its_format_else_viewers_draw_nothing_until_the_next(tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE) as logger:
        form = rr.components.ImageFormat(width=2, height=1, channel_datatype=rr.ChannelDatatype.U8)
        logger.log_static("later", rr.SegmentationImage.from_fields(format=form))
        pixels = rr.SegmentationImage.columns(buffer=np.zeros((1, 2), np.uint8))
        logger.log_columns("later", ([1], [0], [0]), pixels)
        for first in (0, 2):
            logger.log_video("clip", torch.zeros(2, 3, 4, 5, dtype=torch.uint8), step=first)
        logger.log_frames(frames(3)[0])
    drawn, formats = set(), set()
    for chunk in RrdReader(tmp_path / "run.rrd").stream():
        for name in chunk.to_record_batch().schema.names:
            if name.endswith("Image:format"):
                assert not (chunk.is_static and chunk.entity_path in drawn), "a later one hides it"
                formats.add(chunk.entity_path)
        if any(name.endswith("Image:buffer") for name in chunk.to_record_batch().schema.names):
            assert chunk.entity_path in formats
            drawn.add(chunk.entity_path)
    assert drawn == {"/later", "/clip", "/world/board", "/windows"}


def test_a_recording_is_never_written_over(tmp_path):
    RerunLogger("run", tmp_path).shutdown()
    before = (tmp_path / "run.rrd").read_bytes()
    with pytest.raises(FileExistsError, match="exists and is not overwritten"):
        RerunLogger("run", tmp_path)
    assert (tmp_path / "run.rrd").read_bytes() == before


def test_frames_without_a_scene_are_refused(tmp_path):
    with RerunLogger("run", tmp_path) as logger, pytest.raises(ValueError, match="no scene"):
        logger.log_frames(frames(1)[0])


def test_classes_are_known_from_colours_and_foreign_colours_are_marked():
    windows = np.zeros((1, 2, *GAME.observation_shape), np.uint8)
    windows[0, 0, :, 0, 0] = CLASS_COLOURS[SELF]
    windows[0, 0, :, 0, 1] = CLASS_COLOURS[BEAM]
    windows[0, 1, :, 0, 0] = (1, 2, 3)
    windows[0, 1, :, 0, 1] = CLASS_COLOURS[APPLE]
    assert classes_seen(GAME, windows)[:, :, 0, :2].tolist() == [[[SELF, BEAM], [UNSEEN, APPLE]]]


@pytest.mark.parametrize("encoding", ["rgb", "one_hot"])
@pytest.mark.parametrize("agents_apart", [False, True])
def test_classes_are_known_in_every_form_of_observation(encoding, agents_apart):
    game = replace(GAME, observation=Observation(encoding=encoding, agents_apart=agents_apart))
    env = CommonsEnv(game)
    env.reset()
    classes = classes_seen(game, env.output.observation)
    other = FIRST_AGENT + 1 if agents_apart else OTHER
    assert (classes[0, 0] == SELF).sum() == 1
    assert (classes[0, 0] == other).sum() == 1
    assert set(np.unique(classes)) <= {*range(FIRST_AGENT), FIRST_AGENT, FIRST_AGENT + 1}


def test_the_board_has_a_rim_of_wall_and_inner_walls():
    scene = Scene(height=1, width=2, walls=((0, 1),), sites=(), agents=("agent_0",), window=(1, 1))
    nowhere = np.array([[0]])
    nobody = {"in_play": np.array([[False]]), "row": nowhere, "col": nowhere, "step": np.array([1])}
    assert boards(scene, nobody).tolist() == [[[WALL] * 4, [WALL, GROUND, WALL, WALL], [WALL] * 4]]


@pytest.mark.integration
def test_the_live_recording_is_served_on_this_machine_and_rows_that_another_client_adds_stay_there(tmp_path):
    with RerunLogger("run", tmp_path, live="serve", recording_id="one") as logger:
        address = logger.addresses["native"].split()[-1]
        host, port = address.removeprefix("rerun+http://").removesuffix("/proxy").split(":")
        assert host == "127.0.0.1"
        page = logger.addresses["browser"]
        assert page.startswith("http://127.0.0.1:")
        wait(lambda: listens(int(port)) and listens(urlsplit(page).port))
        other = rr.RecordingStream("cprl", recording_id="one", send_properties=False)
        other.connect_grpc(address)
        times = [rr.TimeColumn("step", sequence=np.arange(3))]
        other.send_columns("return", times, rr.Scalars.columns(scalars=np.zeros(3)))
        other.flush(timeout_sec=5)
        logger.log_scalar("return", 7.0)
        other.disconnect()
    assert column(tmp_path / "run.rrd", "return", "Scalars:scalars")[1] == [[7.0]]


class Broken:
    """A stream whose disk is full."""

    def __getattr__(self, name):
        def fail(*arguments, **named):
            raise OSError("no space left on device")

        return fail


@pytest.mark.integration
def test_a_stream_that_fails_is_dropped_with_one_warning_and_the_other_goes_on(tmp_path):
    with RerunLogger("run", tmp_path, curves=SCENE, live="serve") as logger:
        live = next(stream for stream in logger._streams if stream.name == "live view")
        live.recording = Broken()
        with warnings.catch_warnings(record=True, action="always") as caught:
            logger.log_frames(frames(3)[0])
            live.close()  # after all calls, which another thread makes
        (warning,) = caught
        assert re.search(r"live view failed.*no space left", str(warning.message))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            logger.log_frames(frames(3, first_step=10)[0])
            logger.log_scalar("social/equality", 0.5)
            logger.flush()
    assert column(tmp_path / "run.rrd", "world/board", "SegmentationImage:buffer")[0] == [1, 2, 3, 10, 11, 12]


@pytest.mark.integration
def test_a_watched_training_records_every_turn(tmp_path):
    watched_training(tmp_path)
    path = tmp_path / "run.rrd"
    steps, _ = column(path, "world/board", "SegmentationImage:buffer")
    episodes, _ = column(path, "world/board", "SegmentationImage:buffer", "episode")
    ends = np.cumsum([own[0] for own in column(path, "social/survival_steps", "Scalars:scalars")[1]])
    assert sorted([*steps, *ends]) == list(range(1, int(ends[-1]) + 1)), "every turn but the last of each"
    assert sorted(set(episodes)) == [0, 1, 2, 3]
    assert column(path, "agent_0/return", "Scalars:scalars", "episode")[0] == [0, 1, 2, 3]
    assert column(path, "agent_0/loss", "Scalars:scalars", "episode")[0] == [0, 1, 2, 3]
    assert len(column(path, "social/survival_steps", "Scalars:scalars")[0]) == 4


FRAMES = 60


def torchrl_example(logger):
    """A DQN agent by TorchRL's `Trainer`, watched by TorchRL's hooks; what it collected is returned."""
    value = TensorDictModule(torch.nn.Linear(5, 2), in_keys=["place"], out_keys=["action_value"])
    greedy = TensorDictSequential(value, QValueModule(action_space="categorical"))

    def corridor():
        return GymWrapper(Corridor(), categorical_action_encoding=True)

    explore = EGreedyModule(corridor().action_spec, eps_init=0.5, eps_end=0.5)
    trainer = Trainer(
        collector=Collector(
            corridor(),
            TensorDictSequential(greedy, explore),
            frames_per_batch=12,
            total_frames=FRAMES,
            auto_register_policy_transforms=False,
        ),
        total_frames=FRAMES,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=DQNLoss(greedy, action_space="categorical", delay_value=False),
        optimizer=torch.optim.Adam(value.parameters()),
        logger=logger,
        log_interval=1,
        progress_bar=False,
    )
    rewards = []
    camera = VideoRecorder(logger, tag="corridor", in_keys=["pixels"], skip=1, make_grid=False)
    trainer.register_op("batch_process", lambda batch: rewards.append(batch["next", "reward"].mean().item()))
    LogScalar(("next", "reward"), logname="r_training").register(trainer)
    LogValidationReward(
        record_interval=2,
        record_frames=6,
        policy_exploration=greedy,
        environment=TransformedEnv(corridor(), camera),
    ).register(trainer)
    trainer.train()
    return rewards


# TorchRL 0.14.1's Trainer warns of the hooks that it registers itself.
@pytest.mark.filterwarnings("ignore:The .* hook stage will be replaced:FutureWarning")
def test_a_torchrl_example_that_knows_nothing_of_cprl_is_recorded(tmp_path):
    with RerunLogger("corridor", tmp_path) as logger:
        rewards = torchrl_example(logger)
    path = tmp_path / "run.rrd"
    steps, logged = column(path, "r_training", "Scalars:scalars")
    assert steps == [12, 24, 36, 48, 60]
    assert [value[0] for value in logged] == pytest.approx(rewards)
    steps, losses = column(path, "loss", "Scalars:scalars")
    assert steps == [12, 24, 36, 48, 60]
    assert all(loss[0] > 0 for loss in losses)
    steps, evaluated = column(path, "r_evaluation", "Scalars:scalars")
    assert steps == [12, 36, 60], "in every second batch"
    steps, images = column(path, "corridor", "Image:buffer")
    assert steps == list(range(21)), "the recorder counts clips of seven images, which follow each other"
    pictures = np.array(images, np.uint8).reshape(3, 7, 2, 5, 3)
    assert (pictures.max(-1).sum((2, 3), dtype=int) == 255).all(), "one white pixel in each"
    places = pictures[..., 0, :, 0].argmax(-1)
    assert places[:, 0].tolist() == [0, 0, 0]
    filmed = places[:, 1:].mean(1), np.array(evaluated)[:, 0]
    assert filmed[0] == pytest.approx(filmed[1]), "the film shows what was paid: the cell's number"


def test_mosaics_put_low_windows_below_each_other_and_high_ones_side_by_side():
    low = np.array([[[[SELF, BEAM, WALL]], [[GROUND, APPLE, OTHER]]]], np.uint8)
    assert mosaic(low).tolist() == [[[SELF, BEAM, WALL], [UNSEEN] * 3, [GROUND, APPLE, OTHER]]]
    assert windows_of(4, (7, 15)).corners.tolist() == [[0, 0], [0, 16], [8, 0], [8, 16]]
    high = np.array([[[[SELF], [BEAM], [WALL]], [[GROUND], [APPLE], [OTHER]]]], np.uint8)
    assert mosaic(high).tolist() == [[[SELF, UNSEEN, GROUND], [BEAM, UNSEEN, APPLE], [WALL, UNSEEN, OTHER]]]
