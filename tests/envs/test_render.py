"""`CommonsEnv.render` gives the pictures that TorchRL's recorders write."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.record import PixelRenderTransform, VideoRecorder

from cprl import CommonsEnv, Game, Rules, maps
from cprl.envs import parallel_env
from cprl.pictures.image import world_image

MEADOW = Game(
    map=maps.parse(
        """
        .A>.A.A
        #.....A
        ..<.A.A
        """
    ),
    rules=Rules(regrow_prob=(0.0, 0.5), window_rows=3, window_columns=5, episode_steps=4, freeze_steps=2),
)
SIZE = (3 * 8 + 1, 7 * 8 + 1, 3)
"""Rows, columns and channels of an image with cells of 8 pixels."""


def test_a_rollout_has_the_pixels_of_every_world_after_every_step():
    env = TransformedEnv(CommonsEnv(MEADOW, 3, seed=1), PixelRenderTransform(cell_pixels=8))
    env.set_seed(1)
    steps = env.rollout(4)
    assert steps["pixels"].shape == steps["next", "pixels"].shape == (3, 4, *SIZE)
    assert steps["pixels"].dtype == torch.uint8
    assert torch.equal(steps["pixels"][:, 1:], steps["next", "pixels"][:, :-1])
    commons = env.base_env
    for world in range(3):
        now = world_image(MEADOW.map, commons.worlds.show(commons.output, world=world), cell_pixels=8)
        assert np.array_equal(steps["next", "pixels"][world, -1], now)
    worlds = steps["next", "pixels"][:, -1]
    assert not torch.equal(worlds[0], worlds[1]), "each world its own"
    assert env.observation_spec["pixels"].is_in(steps["next", "pixels"][:, -1])


def test_it_is_the_picture_that_pettingzoo_gets():
    env, theirs = CommonsEnv(MEADOW, 2, seed=5), parallel_env(MEADOW, 5, render_mode="rgb_array")
    moment = env.reset()
    theirs.reset()
    actions = torch.tensor([[0, 6], [0, 6]])
    env.step(moment.set(("agents", "action"), actions))
    theirs.step({"agent_0": 0, "agent_1": 6})
    assert np.array_equal(env.render(world=0), theirs.render())
    assert np.array_equal(env.render()[0], theirs.render())


@pytest.mark.parametrize("world", [None, 0])
def test_torchrls_video_recorder_takes_the_worlds_as_a_grid_or_one_of_them(world):
    videos = {}
    logger = SimpleNamespace(log_video=lambda name, video, **named: videos.update({name: video}))
    env = TransformedEnv(CommonsEnv(MEADOW, 2, seed=1), PixelRenderTransform(cell_pixels=8, world=world))
    env.append_transform(VideoRecorder(logger, "boards"))
    env.rollout(4)
    env.transform.dump()
    assert videos["boards"].shape[2] == 3
    frames = videos["boards"][0].permute(0, 2, 3, 1)
    apple, ground = env.base_env.render(world=0)[4, 12], env.base_env.render(world=0)[4, 4]
    assert (frames == apple).all(-1).any()
    assert (frames == ground).all(-1).any()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"world": 2}, "world is 2"),
        ({"cell_pixels": 7}, "cell_pixels is 7"),
        ({"cell_pixels": 8.5}, r"cell_pixels is 8\.5; allowed"),
    ],
)
def test_wrong_arguments_are_refused(wrong, said):
    env = CommonsEnv(MEADOW, 2, seed=1)
    with pytest.raises(ValueError, match=r"the worlds have not begun; allowed: reset\(\) or load\(\) before"):
        env.render()
    env.reset()
    with pytest.raises(ValueError, match=said):
        env.render(**wrong)
