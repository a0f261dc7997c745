"""Helpers of the tests: recordings of a small game, read back by Rerun's own reader."""

from types import SimpleNamespace

import numpy as np
from dqn_parts import make_learner
from rerun.chunk import RrdReader

from cprl import CommonsEnv, Game, Rules, maps
from cprl.algorithms import DQN
from cprl.commons.cells import CLASS_COLOURS
from cprl.learners.settings import DQNSettings
from cprl.measuring.series import Observer
from cprl.pictures.decoding import classes_seen
from cprl.policies.actors import RandomActor
from cprl.training import Schedule, train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.scene import Scene

GAME = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.1), window_rows=3, window_columns=5, episode_steps=20),
)

SCENE = Scene(height=3, width=5, walls=(), sites=GAME.map.sites, agents=GAME.agent_names, window=(3, 5))


def column(path, entity, component, timeline="step"):
    """The times and values of one column of a recording."""
    times, values = [], []
    for chunk in RrdReader(path).stream().filter(content=f"/{entity}"):
        batch = chunk.to_record_batch()
        if component in batch.schema.names and timeline in batch.schema.names:
            times += batch.column(timeline).to_pylist()
            values += batch.column(component).to_pylist()
    return times, values


def static(path, entity, component):
    """The static value of one component."""
    for chunk in RrdReader(path).stream().filter(content=f"/{entity}"):
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            return batch.column(component).to_pylist()[0]
    return None


def names(view):
    """The names of all views and tabs of a layout."""
    found = [str(own) for own in [getattr(view, "name", None)] if own]
    for inner in getattr(view, "contents", None) or ():
        found += names(inner) if not isinstance(inner, str) else []
    return found


def observing(viewer):
    """An observer of a training that this viewer alone watches."""
    return Observer([viewer], viewer.env, worlds=viewer.logger.curves.worlds)


def frames(count, *, first_step=1):
    """So many frames of two agents, each frame another."""
    random = np.random.default_rng(0)
    sites = len(GAME.map.sites)
    shown = []
    for step in range(count):
        frame = SimpleNamespace(
            step=first_step + step,
            episode=7,
            beams=np.arange(15).reshape(3, 5) < step // 2,
            stock=random.integers(0, 2, sites).astype(np.uint8),
            windows=GAME.palette[random.integers(0, len(CLASS_COLOURS), (2, 3, 5))].transpose(0, 3, 1, 2),
            row=np.array([0, step % 3], np.int32),
            col=np.array([step % 5, 4], np.int32),
            heading=np.array([step % 4, 1], np.int32),
            in_play=np.array([True, step < 2]),
            tagged_by=np.array([-1, 0 if step > 3 else -1], np.int32),
            harvested=np.array([step, 0], np.int32),
        )
        shown.append(frame)
    taken = {name: np.stack([vars(frame)[name] for frame in shown]) for name in vars(shown[0])}
    return {**taken, "windows": classes_seen(GAME, taken["windows"])}, shown


def watched_training(run):
    """Records a training of four episodes of an agent that learns beside a random one."""
    settings = DQNSettings(buffer_size=200, learning_rate=1e-3)
    learner = make_learner(
        DQN(settings=settings), GAME.spaces, agents=(0,), replicas=1, seed=1, engine="torchrl"
    )
    env = CommonsEnv(GAME, seed=1)
    with ViewerCallback(run, env, title="run", episodes=4) as viewer:
        train(env, {(0,): learner}, Schedule(episodes=4), others={1: RandomActor(8)}, callbacks=[viewer])


def headers(path):
    """The first line of each header, with its episode."""
    episodes, texts = column(path, "header", "TextDocument:text", "episode")
    return [(episode, text[0].splitlines()[0]) for episode, text in zip(episodes, texts, strict=True)]


def texts(path):
    """The episode of each event."""
    at, events = column(path, "log", "TextLog:text", "episode")
    return dict(zip([text[0] for text in events], at, strict=True))
