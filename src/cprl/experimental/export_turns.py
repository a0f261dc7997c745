"""export_turns: write fresh episodes of stored agents, step by step, as CSV or as Minari data sets.

Other programs can read these: spreadsheets and statistics the CSV, libraries for offline learning the Minari
data sets.
"""

import csv
import io
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cprl import keys
from cprl.commons.game import Game
from cprl.evaluation.fresh import Recorded, fresh_episodes, record
from cprl.evaluation.populations import refuse_trained_in
from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.system.defaults import FILM_SEED as SEED
from cprl.system.output import say
from cprl.system.working import note_progress, working
from cprl.training.stored import as_loaded
from cprl.values import Positive, checked
from cprl.values.array_types import Int64, UInt8

Format = Literal["csv", "minari"]
_INDICES: Final = ("episode", "turn", "agent")
_HEADINGS: Final = np.array(["up", "right", "down", "left"])
"""The names of headings by their number, see `cprl.maps.Map.starts`."""


class Exported(NamedTuple):
    """An episode of T steps and N agents, ready to be written."""

    observation: UInt8
    """The observations, [T + 1, N, ...], before each step and after the last one."""
    action: Int64
    """The actions by number, [T, N]."""
    columns: dict[str, NDArray[Any]]
    """[T, N] each, the columns of a CSV after episode, turn and agent: "action" by name where the game names
    it; "reward"; "harvest", the reward where the game has none; "in_play", whether the action counted;
    "fired"; "tagged" in this turn. Then what the game has: "row", "column" and "heading" of the agent and
    "stock", the apples on the board, after the turn; "fines" and "transfers"."""
    terminated: bool
    """True where the episode ended by itself, and not by the clock."""


@working("exporting")
def export_turns(
    run: str | Path,
    out: str | Path,
    *,
    format: Format = "csv",
    episodes: int = 20,
    replica: int = 0,
    seed: int = SEED,
) -> list[Path]:
    """Play fresh episodes of a run's agents, with the exploration of evaluation; write what they did, and say
    how much that is.

    Args:
        run: the run's directory.
        out: of "csv", the file: a row for each episode, turn and agent, turns counted from 1, see `Exported`.
            Of "minari" a directory of Minari data sets, one for each agent: `<name of out>/agent_0-v0` and so
            on, which `minari.load_dataset` finds where the environment variable MINARI_DATASETS_PATH is the
            directory that `out` lies in. Actions and rewards of all agents are in the infos of each, as
            "joint_action" and "joint_reward".
        format: "csv", or "minari" with the package of this name.
        episodes: the number of episodes: those of `cprl film` with the same replica and seed, from 0 on.
        replica: the number of the replica.
        seed: the seed of the worlds and of all random choices.

    Returns:
        What was written.

    Raises:
        FileExistsError: if any of it exists.
        ValueError: for an unknown format, a replica that the run lacks, or a seed with which it was trained.
        ModuleNotFoundError: for "minari" without that package.
    """
    format = checked("format", format, Format)
    episodes = checked("episodes", episodes, Positive)
    target = Path(out)
    refuse_to_write_over(target)
    if format == "minari":
        _import_minari()
    loaded = as_loaded(run)
    refuse_trained_in(seed, [loaded])  # before the folder is made

    def played() -> Iterator[Exported]:
        for episode in range(episodes):
            note_progress(episode, episodes, "episodes")
            (fresh_episode,) = fresh_episodes([loaded], replica=replica, episode=episode, seed=seed)
            yield _exported(loaded.game, record(fresh_episode))

    target.parent.mkdir(parents=True, exist_ok=True)
    if format == "csv":
        return _write_csv(target, played())
    return _write_minari(target, list(played()), loaded.game)


def _exported(game: Any, played: Recorded) -> Exported:
    """Return the parts of a recorded episode that are written."""
    action = played.entry(*keys.ACTION)
    nobody = np.zeros(action.shape, np.int64)
    reward = played.entry("next", *keys.REWARD)[..., 0]
    columns = {
        "action": np.array(game.actions)[action] if isinstance(game, Game) else action,
        "reward": reward,
        "harvest": played.entry("next", *keys.HARVEST, lacking=reward),
        "in_play": played.entry(*keys.IN_PLAY, lacking=nobody + 1),
        "fired": played.entry("next", *keys.FIRED, lacking=nobody),
        "tagged": played.entry("next", *keys.TAGGED_BY, lacking=nobody[..., None]).any(-1),
    }
    boards = played.boards[1:]
    if boards:
        stock = np.array([board.stock.sum(dtype=np.int64) for board in boards])
        columns["row"] = np.stack([board.row for board in boards])
        columns["column"] = np.stack([board.col for board in boards])
        columns["heading"] = _HEADINGS[np.stack([board.heading for board in boards])]
        columns["stock"] = nobody + stock[:, None]
    for key in (keys.FINES, keys.TRANSFERS):
        paid = played.entry("next", *key)
        if paid is not None:
            columns[key[-1]] = paid
    after = played.batches[-1]["next"][keys.OBSERVATION].numpy(force=True)
    return Exported(
        observation=np.concatenate([played.entry(*keys.OBSERVATION), after]),
        action=action,
        columns=columns,
        terminated=played.episode.terminated,
    )


def _write_csv(path: Path, played: Iterable[Exported]) -> list[Path]:
    """Write a row for each episode, turn and agent."""
    count = 0

    def write(file: BinaryIO) -> None:
        nonlocal count
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        table = csv.writer(text)
        for number, episode in enumerate(played):
            if number == 0:
                table.writerow((*_INDICES, *episode.columns))
            turn, agent = (np.asarray(index) for index in np.indices(episode.action.shape))
            indices = (np.full_like(turn, number), turn + 1, agent)
            columns = [_plain(values) for values in (*indices, *episode.columns.values())]
            table.writerows(zip(*columns, strict=True))
            count += episode.action.size
        text.flush()
        text.detach()  # the file is closed by who opened it

    write_atomically(path, write)
    say(f"wrote {path}, {count:,} rows")
    return [path]


def _plain(values: NDArray[Any]) -> list[Any]:
    """Return the values of a column as a flat list, bools as 0 and 1."""
    if values.dtype == np.bool_:
        values = values.astype(np.int64)
    return list(values.ravel().tolist())


def _write_minari(folder: Path, played: list[Exported], game: Any) -> list[Path]:
    """Write a Minari data set for each agent."""
    minari = _import_minari()
    from minari.data_collector import EpisodeBuffer

    action_space, observation_space = _gymnasium_spaces(played, game)
    written = []
    with _minari_root(folder.parent):
        for agent in range(played[0].action.shape[1]):
            buffers = []
            for number, episode in enumerate(played):
                buffers.append(EpisodeBuffer(id=number, **_minari_episode(episode, agent)))
            with warnings.catch_warnings():  # about author and address, which users add themselves
                warnings.simplefilter("ignore", UserWarning)
                minari.create_dataset_from_buffers(
                    f"{folder.name}/agent_{agent}-v0",
                    buffers,
                    action_space=action_space,
                    observation_space=observation_space,
                    algorithm_name="cprl",
                    description=f"Agent {agent} of stored agents of cprl in a commons",
                    data_format="arrow",
                )
            written.append(folder / f"agent_{agent}-v0")
    say(f"wrote {folder}, {len(written)} data sets of {len(played):,} episodes each")
    return written


def _gymnasium_spaces(played: Sequence[Exported], game: Any) -> tuple[Any, Any]:
    """Return the action space and the observation space of an agent.

    A game of somebody's own may not state them: then actions are counted, and observations have no bounds.
    """
    import gymnasium

    spaces = getattr(game, "spaces", None)
    observation = played[0].observation[0, 0]
    if spaces is None:
        actions = int(max(episode.action.max() for episode in played)) + 1
        low = -np.inf
        high = np.inf
    else:
        actions = spaces.actions
        low = 0
        high = float(spaces.observation_scale)
    box = gymnasium.spaces.Box(low, high, observation.shape, observation.dtype.type)
    return gymnasium.spaces.Discrete(actions), box


def _minari_episode(episode: Exported, agent: int) -> dict[str, Any]:
    """Return the arguments of Minari's `EpisodeBuffer` for an agent: an episode as it saw it."""
    not_ended = [False] * (len(episode.action) - 1)
    reward = episode.columns["reward"]
    return {
        "observations": list(episode.observation[:, agent]),
        "actions": list(episode.action[:, agent]),
        "rewards": reward[:, agent].tolist(),
        "terminations": [*not_ended, episode.terminated],
        "truncations": [*not_ended, not episode.terminated],
        # Infos have an entry more than steps: the first is that of the reset.
        "infos": {
            "joint_action": [episode.action[0], *episode.action],
            "joint_reward": [np.zeros_like(reward[0]), *reward],
        },
    }


def _import_minari() -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError('--format minari needs minari: pip install "cprl[minari]"') from error
    return minari


@contextmanager
def _minari_root(folder: Path) -> Iterator[None]:
    """Let Minari write below a folder within the block."""
    name = "MINARI_DATASETS_PATH"
    before = os.environ.get(name)
    os.environ[name] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
