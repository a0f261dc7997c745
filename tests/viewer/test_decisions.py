"""In a replay, each frame has a bar for each action of each agent, and the taken one is marked."""

import numpy as np
import pytest
import torch
from recordings import column

from cprl import CommonsEnv, Game, Rules, maps
from cprl.policies.actors import LaneActor
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.scripted import scripted_lanes
from cprl.training import Schedule, train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.replay_views import Decisions
from cprl.viewer.scene import BAR_GAP, BAR_HIGH, BAR_WIDE, decision_panels

GAME = Game(
    map=maps.parse(".A>.A\n.A#A.\nv.<.>"), rules=Rules(window_rows=3, window_columns=5, episode_steps=9)
)
VALUES = torch.tensor([1.0, 5.0, 4.0, 4.0, 3.5, 4.5, -90.0, 4.0])


def fixed(observation):
    """The same values or logits in every lane, whatever is seen."""
    return VALUES.expand(*observation.shape[:2], 8)


def replay(run):
    """A replay of four agents: by action values, by probabilities, at random, scripted."""
    env = CommonsEnv(GAME, 1, seed=1)
    seeds = [(1, agent) for agent in range(4)]
    actors = {
        (0,): LaneActor(fixed, 8, seeds=seeds[:1], agents=1),
        (1,): LaneActor(fixed, 8, seeds=seeds[1:2], agents=1, stochastic=True),
        (2,): LaneActor(None, 8, seeds=seeds[2:3], agents=1),
        (3,): scripted_lanes("greedy", GAME, seeds=seeds[3:], agents=1),
    }
    actors[0,].epsilon = 0.0
    taken = []

    class Remembers:
        def on_step(self, batch):
            taken.append(batch["agents", "action"][0].tolist())

    with ViewerCallback(run, env, title="replay", episodes=1, replay="run.rrd") as viewer:
        policies, logger = JointPolicy(actors), viewer.logger
        shown = Decisions(logger, logger.scene, policies, actions=GAME.actions)
        train(env, {}, Schedule(episodes=1), others=actors, callbacks=[Remembers(), viewer, shown])
    return run / "run.rrd", taken, shown


def bars(image, agent, window=(3, 5)):
    """The height of each bar of an agent, and the index of the marked one."""
    panels = decision_panels(4, 8, window)
    top, left = panels.corners[agent]
    part = image.reshape(panels.shape)[top : top + BAR_HIGH, left : left + panels.size[1]]
    columns = part[:, BAR_GAP + BAR_WIDE // 2 :: BAR_GAP + BAR_WIDE]
    marked = np.flatnonzero(((columns > 0) & (columns % 2 == 0)).any(0))
    return (columns > 0).sum(0), marked


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    return replay(tmp_path_factory.mktemp("replay"))


def test_each_frame_shows_what_agents_choose_next_by_what_they_see(played):
    path, taken, _ = played
    frames, images = column(path, "decisions", "SegmentationImage:buffer", "frame")
    assert frames == column(path, "world/board", "SegmentationImage:buffer", "frame")[0]
    assert len(frames) == len(taken) - 1
    for pixels, actions in zip(images, taken[1:], strict=True):
        image = np.array(pixels[0], np.uint8).view(np.uint16)
        for agent in (0, 1):
            assert bars(image, agent)[1] == [actions[agent]]


def test_bars_are_values_of_the_moment_or_probabilities(played):
    path, _, _ = played
    _, images = column(path, "decisions", "SegmentationImage:buffer", "frame")
    image = np.array(images[0][0], np.uint8).view(np.uint16)
    by_value, greedy = bars(image, 0)
    assert greedy == [1]
    assert by_value.argmax() == 1
    assert by_value[0] == by_value[6] == 1, "one poor action leaves the others apart"
    assert 1 < by_value[4] < by_value[2] < by_value[5] < by_value[1] == BAR_HIGH - 1
    by_chance, _ = bars(image, 1)
    shares = VALUES.double().softmax(-1).numpy()
    assert by_chance.tolist() == (1 + (shares * (BAR_HIGH - 2)).round()).tolist()
    assert not bars(image, 2)[0].any()
    assert not bars(image, 3)[0].any()


def test_agents_without_values_say_so(played):
    path, _, _ = played
    _, labels = column(path, "decisions/labels", "Points2D:labels", "frame")
    assert labels[0] == [
        "agent_0: Q 3.00 to 5.00",
        "agent_1: probabilities",
        "agent_2: acts at random",
        "agent_3: has no values",
    ]


def test_asking_for_action_values_draws_no_random_numbers():
    observation = torch.zeros(1, 1, 3, 3, 5, dtype=torch.uint8)
    asked, other = (LaneActor(fixed, 8, seeds=[(3, 0)], agents=1, stochastic=True) for _ in range(2))
    chosen = []
    for _ in range(20):
        assert asked.action_values(observation).sum() == pytest.approx(1)
        chosen.append((asked.choose(observation).item(), other.choose(observation).item()))
    assert all(one == two for one, two in chosen)
    assert len(set(chosen)) > 1
    assert LaneActor(None, 8, seeds=[(3, 0)], agents=1).action_values(observation) is None
