"""Export fresh episodes of stored agents for other programs: as CSV, or as Minari data sets."""

import csv
import io
import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.unwrap import commons_of
from cprl.evaluation.evaluate import opened
from cprl.evaluation.fresh import fresh_episode
from cprl.evaluation.lanes import Turns, board_now, refuse_trained_in
from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.system.defaults import FILM_SEED as SEED
from cprl.system.output import say
from cprl.system.working import say_how_far, working
from cprl.values import Positive, checked

Format = Literal["csv", "minari"]
COLUMNS: Final = ("episode", "turn", "agent", "action", "reward", "harvest", "in_play", "fired", "tagged")
"""Of a CSV, a row for each episode, turn and agent, turns counted from 1; `in_play` says whether the action
of the turn counted, `tagged` whether the agent was tagged in it. Then what the game has: `row`, `column` and
`heading` of the agent and `stock`, the apples on the board, after the turn; its `fines` and `transfers`."""


_PLACES: Final = ("row", "column", "heading", "stock")
_HEADINGS: Final = ("up", "right", "down", "left")
"""By number, see `cprl.maps.Map.starts`."""


class Played(NamedTuple):
    """An episode of T turns of N agents."""

    observation: NDArray[np.uint8]
    """[T + 1, N, ...], before each turn and after the last one."""
    action: NDArray[np.int64]
    """[T, N]."""
    reward: NDArray[np.float32]
    """[T, N]."""
    harvest: NDArray[np.float32]
    """[T, N]; the reward where the game has none."""
    in_play: NDArray[np.bool_]
    """[T, N], before each turn."""
    fired: NDArray[np.bool_]
    """[T, N]."""
    tagged: NDArray[np.bool_]
    """[T, N]."""
    more: dict[str, NDArray[Any]]
    """[T, N] by the name of a column, what not every game has."""
    terminated: bool
    """Whether the episode ended by itself, and not by the clock."""


@working("exporting")
def export_episodes(
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
        out: of "csv", the file. Of "minari" a directory of Minari data sets, one for each agent:
            `<name of out>/agent_0-v0` and so on, which `minari.load_dataset` finds where the environment
            variable MINARI_DATASETS_PATH is the directory that `out` lies in. Actions and rewards of all
            agents are in the infos of each, as "joint_action" and "joint_reward".
        episodes: which are those of `cprl film` with the same replica and seed, from 0 on.

    Returns:
        What was written.

    Raises:
        FileExistsError: if any of it exists.
        ModuleNotFoundError: for "minari" without that package.
    """
    format = checked("format", format, Format)
    episodes, target = checked("episodes", episodes, Positive), Path(out)
    refuse_to_write_over(target)
    if format == "minari":
        _import_minari()
    loaded = opened(run)
    refuse_trained_in(seed, [loaded])  # before the folder is made

    def played() -> Iterator[tuple[Played, Any]]:
        for episode in range(episodes):
            say_how_far(episode, episodes, "episodes")
            fresh = fresh_episode(loaded, replica=replica, episode=episode, seed=seed)
            yield _play(Turns(fresh.env, fresh.policies)), fresh.run.game

    target.parent.mkdir(parents=True, exist_ok=True)
    return _write_csv(target, played()) if format == "csv" else _write_minari(target, list(played()))


@working("playing an episode")
def _play(turns: Turns) -> Played:
    batches = []
    places = []
    commons = commons_of(turns.env)
    while not turns.has_ended:
        batches.append(turns.play().clone())
        if commons is not None:
            now = board_now(commons)
            headings = [_HEADINGS[heading] for heading in now.heading]
            places.append((now.row, now.col, headings, [now.stock.sum(dtype=np.int64)] * len(headings)))
    agents, last = keys.AGENTS, batches[-1]

    def stacked(*name: str, lacking: Any = None) -> Any:
        """An entry of all turns; the other value where the game has none."""
        if batches[0].get(name, None) is None:
            return lacking
        return np.stack([batch[name][0].numpy(force=True) for batch in batches])

    observed, action = stacked(agents, "observation"), stacked(agents, "action")
    reward, nobody = stacked("next", agents, "reward")[..., 0], np.zeros(action.shape, np.bool_)
    more = dict(zip(_PLACES, map(np.array, zip(*places, strict=True)), strict=True)) if places else {}
    paid = {"fines": stacked("next", *keys.FINES), "transfers": stacked("next", *keys.TRANSFERS)}
    more |= {name: values for name, values in paid.items() if values is not None}
    return Played(
        observation=np.concatenate([observed, last["next", agents, "observation"].numpy(force=True)]),
        action=action,
        reward=reward,
        harvest=stacked("next", *keys.HARVEST, lacking=reward),
        in_play=stacked(agents, "in_play", lacking=~nobody),
        fired=stacked("next", agents, "fired", lacking=nobody),
        tagged=stacked("next", *keys.TAGGED_BY, lacking=nobody[..., None]).any(-1),
        more=more,
        terminated=bool(last["next", "terminated"].any()),
    )


def _write_csv(path: Path, played: Iterable[tuple[Played, Any]]) -> list[Path]:
    count = 0

    def write(file: BinaryIO) -> None:
        nonlocal count
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        table = csv.writer(text)
        for episode, (one, game) in enumerate(played):
            if not episode:
                table.writerow((*COLUMNS, *one.more))
            names = game.actions if isinstance(game, Game) else ()
            for turn, agent in np.ndindex(one.action.shape):
                action = int(one.action[turn, agent])
                numbers = (float(one.reward[turn, agent]), float(one.harvest[turn, agent]))
                flags = (int(flag[turn, agent]) for flag in (one.in_play, one.fired, one.tagged))
                more = (values[turn, agent].item() for values in one.more.values())
                called = names[action] if names else action
                table.writerow((episode, turn + 1, agent, called, *numbers, *flags, *more))
            count += one.action.size
        text.flush()
        text.detach()  # the file is closed by who opened it

    write_atomically(path, write)
    say(f"wrote {path}, {count:,} rows")
    return [path]


def _write_minari(folder: Path, played: list[tuple[Played, Any]]) -> list[Path]:
    import gymnasium

    minari = _import_minari()
    from minari.data_collector import EpisodeBuffer

    first, game = played[0][0], played[0][1]
    spaces = game.spaces if hasattr(game, "spaces") else None
    actions = spaces.actions if spaces is not None else int(max(one.action.max() for one, _ in played)) + 1
    seen = first.observation[0, 0]
    high = float(spaces.observation_scale) if spaces is not None else float(np.inf)
    observation_space = gymnasium.spaces.Box(0 if spaces else -np.inf, high, seen.shape, seen.dtype.type)
    written = []
    with _minari_root(folder.parent):
        for agent in range(first.action.shape[1]):
            buffers = [
                EpisodeBuffer(
                    id=number,
                    observations=list(one.observation[:, agent]),
                    actions=list(one.action[:, agent]),
                    rewards=one.reward[:, agent].tolist(),
                    terminations=[False] * (len(one.action) - 1) + [one.terminated],
                    truncations=[False] * (len(one.action) - 1) + [not one.terminated],
                    infos={
                        "joint_action": [one.action[0], *one.action],
                        "joint_reward": [np.zeros_like(one.reward[0]), *one.reward],
                    },
                )
                for number, (one, _) in enumerate(played)
            ]
            with warnings.catch_warnings():  # of authors and addresses, which are the user's to add
                warnings.simplefilter("ignore", UserWarning)
                minari.create_dataset_from_buffers(
                    f"{folder.name}/agent_{agent}-v0",
                    buffers,
                    action_space=gymnasium.spaces.Discrete(actions),
                    observation_space=observation_space,
                    algorithm_name="cprl",
                    description=f"Agent {agent} of stored agents of cprl in a commons",
                    data_format="arrow",
                )
            written.append(folder / f"agent_{agent}-v0")
    say(f"wrote {folder}, {len(written)} data sets of {len(played):,} episodes each")
    return written


def _import_minari() -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError('--format minari needs minari: pip install "cprl[minari]"') from error
    return minari


@contextmanager
def _minari_root(folder: Path) -> Iterator[None]:
    """While it is open, Minari writes below a folder."""
    name, before = "MINARI_DATASETS_PATH", os.environ.get("MINARI_DATASETS_PATH")
    os.environ[name] = str(folder.resolve())
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
