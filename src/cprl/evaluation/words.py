"""What a word names: a board to play on, and who plays."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from cprl import arguments, presets
from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.rules import Rules
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import AgentSpec, Frozen, Scripted
from cprl.presets import Variant
from cprl.stored import LoadedRun, load

_LONGEST_DRAWING_BYTES: Final = 10_000_000


def board_named(
    board: str, variant: Variant = "published", *, allow: Sequence[str] = ()
) -> tuple[Game, LoadedRun | None]:
    """A game, and the run that has it.

    Args:
        board: the name of a published board, the directory of a run, whose game it is then, or a file with a
            drawing, see `cprl.maps.parse`, played by the published rules.
        variant: of a published board, see `presets.game`.
        allow: see `cprl.load`.

    Raises:
        ValueError: for anything else, and for a variant of what is no published board.
    """
    arguments.choice("variant", variant, presets.VARIANTS)
    presets.check_board(board)
    if board in presets.BOARDS:
        return presets.game(board, variant=variant), None
    path = Path(board)
    if variant != "published":
        raise ValueError(
            f'variant is "{variant}"; allowed with {board}: "published", since it names no preset'
        )
    if path.is_dir():
        run = load(path, allow=allow)
        if not isinstance(run.game, Game):
            raise ValueError(f"{board} plays a game without a board of cprl; allowed: a run of a cprl.Game")
        return run.game, run
    if path.stat().st_size > _LONGEST_DRAWING_BYTES:
        raise ValueError(f"{path} has more than {_LONGEST_DRAWING_BYTES:,} bytes; allowed: a drawing")
    try:
        return Game(map=maps.parse(path.read_text(encoding="utf-8")), rules=Rules()), None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def agent_named(who: str, agent: int, *, replica: int | None, name: str = "others") -> AgentSpec:
    """Who plays at an index: a scripted policy, or the agent of a run with that index.

    Args:
        who: the name of a scripted policy, or the directory of a run.
        agent: the index.
        replica: the run's replica, see `Frozen`.
        name: what an error calls the word.

    Raises:
        ValueError: for anything else.
    """
    if who in SCRIPTED_POLICIES:
        return Scripted(who)
    if not arguments.path(name, who).is_dir():
        names = ", ".join(SCRIPTED_POLICIES)
        raise ValueError(f"{name} is {who!r}; allowed: {names}, or a run's directory")
    return Frozen(str(who), agent, replica)
