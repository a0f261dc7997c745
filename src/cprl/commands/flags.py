"""Values as flags: each field of an experiment that words can say, e.g. --game.rules.freeze-steps 50.

tyro reads dataclasses itself. The rule here tells it what it cannot know of a value that is there already: of
which class each part is, and what no word can say and therefore stays.
"""

import inspect
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from cprl.commons.published import Variant
from cprl.system.output import say
from cprl.values import Custom, fits, hints_of, refusal

if TYPE_CHECKING:
    import pyarrow as pa

    from cprl.experiment import Experiment
    from cprl.institutions import Institution
    from cprl.population import AgentSpec
    from cprl.terminal.tables import Cells


NO_DEFAULT: Final = tyro.conf.arg(help_behavior_hint="")
"""Of a flag whose default says nothing: its text says what happens without it."""


Run = Annotated[
    Path,
    tyro.conf.arg(
        metavar="RUN",
        help="The run's directory, or its results; of one that has not ended the newest checkpoint plays.",
    ),
]
Runs = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="RUN [RUN ...]",
        help="Directories of runs of the same game, or their results; NAME=PATH gives one another name.",
        help_behavior_hint="",
    ),
]
Board = Annotated[
    str,
    tyro.conf.arg(
        metavar="BOARD",
        help="commons, two_complex, single_complex or single_basic; or the directory of a run, whose game is "
        "played; or a file with a drawing.",
    ),
]
VariantFlag = Annotated[
    Variant,
    tyro.conf.arg(help="Of the boards with a name: published or as_run; see docs/game.md."),
]
ROWS: Final = ".parquet"
"""What the name of a file with every row ends in."""


def _hint(default: str) -> str:
    return f"(default: {default})" if default else ""


def with_help(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose flags, with those of its dataclasses, have their texts in lines as wide as the
    terminal, and show no default that is None or ()."""
    parameters = inspect.signature(function).parameters
    _describe(function, {name: parameter.default for name, parameter in parameters.items()})
    for parameter in parameters.values():
        if is_dataclass(parameter.default):
            of_class = {field.name: field.default for field in fields(parameter.default)}
            _describe(type(parameter.default), of_class)
    return function


def _describe(owner: Any, defaults: Mapping[str, Any]) -> None:
    from docstring_parser import parse_from_object  # as tyro does

    for base in getattr(owner, "__mro__", (owner, object))[:-1]:  # all but object
        texts = {part.arg_name: part.description or "" for part in parse_from_object(base).params}
        hints = get_type_hints(base, include_extras=True)
        for name in inspect.get_annotations(base):
            is_empty = name in defaults and (defaults[name] is None or defaults[name] == ())
            text = " ".join(texts.get(name, "").split()) or None
            flag = tyro.conf.arg(help=text, help_behavior_hint="" if is_empty else None)
            base.__annotations__[name] = Annotated[hints[name], flag]


@dataclass(frozen=True, kw_only=True)
class Tables:
    """Which files of tables are written; none is written over."""

    out: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A new file; may be repeated. By its suffix it has every row (.parquet), or the tables that are printed
    (.txt, .md, .tex, or .csv with the bounds of intervals as columns)."""
    csv: bool = False
    """Print every row as CSV, and nothing else."""

    def check(self) -> None:
        """Refuse what cannot be written before hours of work."""
        from cprl.runs.files import refuse_to_write_over
        from cprl.terminal.tables import SUFFIXES

        others = [name for name, value in vars(self).items() if value and name not in ("csv", "figure_width")]
        if self.csv and others:
            cure = others[0] + ", as --out FILE.csv writes means and intervals" * (others[0] == "out")
            raise ValueError(f"--csv prints every row and nothing else; allowed: without --{cure}")
        for path in self.out:
            if path.suffix not in (ROWS, *SUFFIXES):
                raise refusal("--out", str(path), f"a name that ends in {', '.join((ROWS, *SUFFIXES))}")
            if self.out.count(path) > 1:
                raise refusal("--out", str(path), "each file once")
            refuse_to_write_over(path)

    def write(self, rows: "pa.Table", tables: "Sequence[Cells]" = (), *, notes: Sequence[str] = ()) -> None:
        """Write the files, and say so.

        Args:
            rows: of a .parquet.
            tables: of the other files, with notes below them.
        """
        from cprl.runs.episodes import write_table
        from cprl.terminal.tables import write

        for path in self.out:
            if path.suffix == ROWS:
                write_table(path, rows)
            else:
                write(tables, path, notes=notes)
            say(f"Written: {path}")


@dataclass(frozen=True, kw_only=True)
class Files(Tables):
    """Which files of tables and figures are written; none is written over."""

    figure: Path | None = None
    """A new .png, .pdf or .svg, see docs/evaluation.md."""
    figure_width: Literal["page", "column"] = "page"
    """Of the figure: a page, or a column of a paper, 3.3 inches, with its caption in a file beside it."""

    def check(self) -> None:
        super().check()
        if self.figure is not None:
            from cprl.terminal.style import check_picture

            check_picture(self.figure, "--figure")


TableFlags = Annotated[Tables, tyro.conf.arg(name="")]
FileFlags = Annotated[Files, tyro.conf.arg(name="")]


class RefusedError(Exception):
    """A value that words describe is refused; of no kind that tyro wraps into a text of its own."""


class ValueFlags(ConstructorRegistry):
    """How tyro reads the fields of a dataclass that has a default: as changes to it.

    Args:
        listed: the places that help lists, or what is above them; None for all. Help lists what stands in a
            tuple once, though equal ones are there.
        is_help: whether words ask for help, which alone leaves flags out.
    """

    def __init__(self, listed: Collection[str] | None = None, *, is_help: bool = False) -> None:
        super().__init__()
        self._listed = listed if is_help else None
        self._is_help = is_help
        self._places: dict[int, str] = {}
        self._is_inside = False
        self.struct_rule(self._changes)

    def _changes(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        value: Any = info.default
        if self._is_inside or isinstance(value, type) or not is_dataclass(value):
            return None
        self._is_inside = True  # in what tyro's own rule says of a dataclass: defaults and help
        try:
            usual = ConstructorRegistry.get_struct_spec(info)
        finally:
            self._is_inside = False
        assert isinstance(usual, StructConstructorSpec)
        settable = {field.name for field in fields(value) if field.init}
        place = self._places.get(id(value), "")
        made: Any = value
        flags = [self._flag(field, place) for field in usual.fields if field.name in settable]

        def changed(**given: Any) -> Any:
            changes = {name: new for name, new in given.items() if new != getattr(value, name)}
            try:
                return replace(made, **changes) if changes else made
            except ValueError as error:
                raise RefusedError(str(error)) from error

        return StructConstructorSpec(instantiate=changed, fields=tuple(flag for flag in flags if flag))

    def _flag(self, field: StructFieldSpec, above: str) -> StructFieldSpec | None:
        value = field.default
        place = f"{above}.{field.name}".lstrip(".")
        kind: Any
        if _is_code(value):
            return None
        if is_dataclass(value):
            self._places.setdefault(id(value), place)
            kind = type(value)
        elif isinstance(value, tuple) and value and all(map(is_dataclass, value)):
            for number, part in enumerate(value):
                self._places.setdefault(id(part), f"{place}.{number}")
            kinds = [
                Annotated[type(part), tyro.conf.Suppress]
                if self._is_help and part in value[:number]
                else type(part)
                for number, part in enumerate(value)
            ]
            kind = tuple[tuple(kinds)]  # type: ignore[misc]
        else:
            kind = _simple(field.type)
            kind = None if kind in (None, NoneType) or not fits(value, kind) else kind
        if kind is None:
            return None
        if value is None or value == ():
            kind = Annotated[kind, NO_DEFAULT, tyro.conf.DisallowNone]
        if self._listed is not None and not any(f"{path}.".startswith(f"{place}.") for path in self._listed):
            kind = Annotated[kind, tyro.conf.Suppress]
        return replace(field, type=kind)


def _is_code(value: Any) -> bool:
    from cprl.commons.maps import Map

    parts = value if isinstance(value, tuple) else (value,)
    return any(isinstance(part, Custom | Map) for part in parts)


_WORDS: Final = (bool, int, float, str, NoneType)


def _simple(hint: Any) -> Any:
    """A type without objects, tables and nested tuples; None if nothing is left."""
    origin = get_origin(hint)
    arguments = get_args(hint)
    if origin is Annotated:
        return hint if _simple(arguments[0]) == arguments[0] else _simple(arguments[0])
    if origin in (Union, UnionType):
        options = [simple for part in arguments if (simple := _simple(part)) is not None]
        return Union[tuple(options)] if options else None  # noqa: UP007
    if origin is tuple:
        parts = [part if part is Ellipsis else _simple(part) for part in arguments]
        return tuple[tuple(parts)] if None not in parts else None  # type: ignore[misc]
    is_simple = hint in _WORDS or origin is Literal or (isinstance(hint, type) and issubclass(hint, Path))
    return hint if is_simple else None


@dataclass(frozen=True, kw_only=True)
class Shape:
    """What decides which other flags there are, and is therefore read first."""

    map: Annotated[str | None, tyro.conf.arg(name="game.map", metavar="NAME")] = None
    """A board by its name: single_basic, single_complex, two_complex or commons."""
    agents: int | None = None
    """How many agents, where all are alike. A board has its first starts then, or more of them on free ground
    around the first one."""
    institutions: Annotated[
        tuple[str, ...],
        tyro.conf.arg(name="game.institutions", metavar="NAME|FILE.json", help_behavior_hint=_hint),
    ] = ()
    """Institutions by their names, e.g. quota monitoring, with flags of their own, e.g.
    --game.institutions.quota.share 0.25; or a JSON file with a list of them as in a recipe.json; or none."""


def in_shape(experiment: "Experiment", shape: Shape) -> "Experiment":
    """Return an experiment on another board, with another number of agents or under other institutions."""
    from cprl.commons import maps
    from cprl.commons.game import Game

    if shape == Shape():
        return experiment
    game = experiment.game
    agents = experiment.agents
    if not isinstance(game, Game):
        raise ValueError("--game.map, --agents and --game.institutions are for games on a board of cprl")
    board = game.map if shape.map is None else maps.named(shape.map)
    if shape.agents is not None:
        board = maps.with_agents(board, shape.agents)
        agents = _as_many(agents, shape.agents)
    institutions = _institutions(shape.institutions) if shape.institutions else game.institutions
    return replace(experiment, game=replace(game, map=board, institutions=institutions), agents=agents)


def _as_many(specs: "tuple[AgentSpec, ...]", agents: int) -> "tuple[AgentSpec, ...]":
    from cprl.population import Team

    first = specs[0]
    if len(specs) == 1 and isinstance(first, Team):
        return (replace(first, agents=tuple(range(agents))),)
    if isinstance(first, Team) or any(spec != first for spec in specs):
        raise ValueError(
            f"--agents is {agents}; allowed: where all agents are alike, which they are not here"
        )
    return (first,) * agents


def _institutions(words: Sequence[str]) -> "tuple[Institution, ...]":
    from cprl.institutions import Institution
    from cprl.values import KINDS, from_config

    kinds = {_snake(name): kind for name, kind in KINDS.items() if issubclass(kind, Institution)}
    made: list[Institution] = []
    for word in () if tuple(words) == ("none",) else words:
        if word.endswith(".json"):
            tables = json.loads(Path(word).read_text(encoding="utf-8"))
            for number, table in enumerate(tables if isinstance(tables, list) else [tables]):
                made.append(from_config(table, f"{word}[{number}]"))
        elif word.replace("-", "_") not in kinds:
            raise ValueError(
                f"--game.institutions is {word}; allowed: {', '.join(sorted(kinds))}, a file .json, or none"
            )
        else:
            try:
                made.append(kinds[word.replace("-", "_")]())
            except TypeError as error:  # without an argument that has no default
                raise ValueError(f"--game.institutions is {word}, {error}; allowed: a file .json") from error
    return tuple(made)


def _snake(name: str) -> str:
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower()


def with_groups(experiment: "Experiment", flags: Sequence[str]) -> "Experiment":
    """Return an experiment with the groups of rules that it lacks and whose fields words of a command line
    set, e.g. --game.rules.random-end.prob 0.15."""
    from cprl.commons.game import Game

    game = experiment.game
    if not isinstance(game, Game):
        return experiment
    places = [flag.partition("=")[0].replace("-", "_").split(".") for flag in flags]
    groups: dict[str, Any] = {}
    for name, hint in hints_of(type(game.rules)).items():
        kinds = [kind for kind in get_args(hint) if is_dataclass(kind)]
        said = [place[3] for place in places if place[:3] == ["__game", "rules", name] and len(place) > 3]
        if kinds and said and getattr(game.rules, name) is None:
            groups[name] = _group(kinds[0], f"--game.rules.{name.replace('_', '-')}", said)
    return replace(experiment, game=replace(game, rules=replace(game.rules, **groups)))


def _group(kind: Any, flag: str, said: Collection[str]) -> Any:
    """Make a group of rules of which words set some fields, all that it requires among them."""
    known = [field.name for field in fields(kind)]
    for name in said:
        if name.removeprefix("no_") not in known:
            raise ValueError(
                f"{flag}.{name.replace('_', '-')} is unknown; allowed: "
                f"{', '.join(field.replace('_', '-') for field in known)}"
            )
    required = [field.name for field in fields(kind) if field.default is MISSING]
    lacking = [name for name in required if name not in said]
    if lacking:
        raise ValueError(f"{flag} lacks {', '.join(lacking)}, which {kind.__name__} requires")
    return kind(**dict.fromkeys(required, 1))  # which the words replace


def shape_of(experiment: "Experiment") -> Shape:
    from cprl.commons import maps
    from cprl.commons.game import Game

    game = experiment.game
    if not isinstance(game, Game):
        return Shape()
    names = [name for name in maps.NAMES if maps.named(name) == game.map]
    return Shape(
        map=names[0] if names else "as drawn", agents=game.agents, institutions=tuple(_kinds(experiment))
    )


def numbered(words: Sequence[str], experiment: "Experiment") -> list[str]:
    """Return words whose flags of institutions have a number in place of a name."""
    above = "--game.institutions."
    kinds = _kinds(experiment)
    changed = []
    for word in words:
        name, dot, field = word.removeprefix(above).partition(".")
        is_name = word.startswith(above) and kinds.count(name.replace("-", "_")) == 1
        number = kinds.index(name.replace("-", "_")) if is_name else 0
        changed.append(f"{above}{number}{dot}{field}" if is_name else word)
    return changed


def _kinds(experiment: "Experiment") -> list[str]:
    return [_snake(type(part).__name__) for part in getattr(experiment.game, "institutions", ())]
