"""Flags of the command line: shared arguments of commands, and flags for every field of an experiment.

A recipe makes an experiment, and flags such as `--game.rules.freeze-steps 50` change it. tyro makes flags
from the annotations of a dataclass. `ValueFlags` tells tyro two things that annotations do not say: the class
of each part of the experiment at hand, e.g. DQN for an algorithm, and which fields no word can describe.
These fields keep their values.
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

from cprl.commons.named_games import Variant
from cprl.system.output import say
from cprl.values import Custom, hints_of, matches_type, refusal

if TYPE_CHECKING:
    import pyarrow as pa

    from cprl.experiment import Experiment
    from cprl.institutions import Institution
    from cprl.population import AgentSpec
    from cprl.terminal.text_tables import TextTable


NO_DEFAULT: Final = tyro.conf.arg(help_behavior_hint="")
"""The setting of a flag whose help shows no default; the text of the flag says what happens without it."""


RunArgument = Annotated[
    Path,
    tyro.conf.arg(
        metavar="RUN",
        help="The run's directory, or its results; of one that has not ended the newest checkpoint plays.",
    ),
]
RunsArgument = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        metavar="RUN [RUN ...]",
        help="Directories of runs of the same game, or their results; NAME=PATH gives one another name.",
        help_behavior_hint="",
    ),
]
BoardArgument = Annotated[
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
"""The suffix of a file that holds every row of a table."""


def _hint(default: str) -> str:
    return f"(default: {default})" if default else ""


def with_help(function: Callable[..., Any]) -> Callable[..., Any]:
    """Prepare a function for the help of tyro, and return it.

    The texts of its flags, and of the flags of its dataclasses, are joined to single lines, which tyro then
    wraps at the width of the terminal. Defaults that are None or () are not shown.
    """
    parameters = inspect.signature(function).parameters
    _describe(function, {name: parameter.default for name, parameter in parameters.items()})
    for parameter in parameters.values():
        if is_dataclass(parameter.default):
            defaults = {field.name: field.default for field in fields(parameter.default)}
            _describe(type(parameter.default), defaults)
    return function


def _describe(owner: Any, defaults: Mapping[str, Any]) -> None:
    """Copy the texts of a docstring into the annotations of the flags.

    Args:
        owner: a function or a dataclass.
        defaults: the default of each flag.
    """
    from docstring_parser import parse_from_object  # as tyro does

    for base in getattr(owner, "__mro__", (owner, object))[:-1]:  # all but object
        texts = {part.arg_name: part.description or "" for part in parse_from_object(base).params}
        hints = get_type_hints(base, include_extras=True)
        for name in inspect.get_annotations(base):
            is_empty = name in defaults and (defaults[name] is None or defaults[name] == ())
            text = " ".join(texts.get(name, "").split()) or None
            hint = "" if is_empty else None
            flag = tyro.conf.arg(help=text, help_behavior_hint=hint)
            base.__annotations__[name] = Annotated[hints[name], flag]


@dataclass(frozen=True, kw_only=True)
class TableFiles:
    """Which files of tables are written; none is written over."""

    out: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A new file; may be repeated. By its suffix it has every row (.parquet), or the tables that are printed
    (.txt, .md, .tex, or .csv with the bounds of intervals as columns)."""
    csv: bool = False
    """Print every row as CSV, and nothing else."""

    def check(self, **beside: object) -> None:
        """Refuse files that cannot be written, before hours of work.

        Args:
            beside: other settings of the command that --csv leaves no room for; none is true by default.
        """
        from cprl.runs.files import refuse_to_write_over
        from cprl.terminal.text_tables import WRITERS

        given = {**vars(self), **beside}
        others = [name for name, value in given.items() if value and name not in ("csv", "figure_width")]
        if self.csv and others:
            cure = others[0] + ", as --out FILE.csv writes means and intervals" * (others[0] == "out")
            raise ValueError(f"--csv prints every row and nothing else; allowed: without --{cure}")
        for path in self.out:
            if path.suffix not in (ROWS, *WRITERS):
                raise refusal("--out", str(path), f"a name that ends in {', '.join((ROWS, *WRITERS))}")
            if self.out.count(path) > 1:
                raise refusal("--out", str(path), "each file once")
            refuse_to_write_over(path)

    def write(
        self, rows: "pa.Table", tables: "Sequence[TextTable]" = (), *, notes: Sequence[str] = ()
    ) -> None:
        """Write the files, and print their names.

        Args:
            rows: the rows of a .parquet file.
            tables: the tables of the other files.
            notes: lines below the tables.
        """
        from cprl.runs.episodes import write_table
        from cprl.terminal.text_tables import write_tables

        for path in self.out:
            if path.suffix == ROWS:
                write_table(path, rows)
            else:
                write_tables(tables, path, notes=notes)
            say(f"Written: {path}")


@dataclass(frozen=True, kw_only=True)
class ResultFiles(TableFiles):
    """Which files of tables and figures are written; none is written over."""

    figure: Path | None = None
    """A new .png, .pdf or .svg, see docs/evaluation.md."""
    figure_width: Literal["page", "column"] = "page"
    """The width of the figure: a page, or a column of a paper, 3.3 inches, with its caption in a file beside
    it."""

    def check(self, **beside: object) -> None:
        super().check(**beside)
        if self.figure is not None:
            from cprl.terminal.picture_files import check_picture

            check_picture(self.figure, "--figure", refuse_existing=True)


TableFlags = Annotated[TableFiles, tyro.conf.arg(name="")]
FileFlags = Annotated[ResultFiles, tyro.conf.arg(name="")]


class RefusedError(Exception):
    """A value on the command line is refused. It is no ValueError, since tyro rewrites their texts."""


class ValueFlags(ConstructorRegistry):
    """A rule for tyro: the flags of a dataclass that has a default value change that value.

    Args:
        listed: the paths of the fields that help lists; None for all. Of equal values in a tuple, help lists
            the first one only.
        is_help: whether the command line asks for help. Otherwise no flag is left out.
    """

    def __init__(self, listed: Collection[str] | None = None, *, is_help: bool = False) -> None:
        super().__init__()
        self._listed = listed if is_help else None
        self._is_help = is_help
        self._places: dict[int, str] = {}
        self._is_inside = False
        self.struct_rule(self._changes)

    def _changes(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        """Return how tyro reads a dataclass with a default value; None for any other type."""
        is_instance = is_dataclass(info.default) and not isinstance(info.default, type)
        if self._is_inside or not is_instance:
            return None
        instance: Any = info.default
        self._is_inside = True  # in what tyro's own rule says of a dataclass: defaults and help
        try:
            usual = ConstructorRegistry.get_struct_spec(info)
        finally:
            self._is_inside = False
        assert isinstance(usual, StructConstructorSpec)
        settable = {field.name for field in fields(instance) if field.init}
        place = self._places.get(id(instance), "")
        flags = [self._flag(field, place) for field in usual.fields if field.name in settable]

        def changed(**settings: Any) -> Any:
            changes = {name: new for name, new in settings.items() if new != getattr(instance, name)}
            try:
                return replace(instance, **changes) if changes else instance
            except ValueError as error:
                raise RefusedError(str(error)) from error

        return StructConstructorSpec(instantiate=changed, fields=tuple(flag for flag in flags if flag))

    def _flag(self, field: StructFieldSpec, above: str) -> StructFieldSpec | None:
        """Return the flag of a field; None if no word can describe its value.

        Args:
            field: the field, as tyro's own rule describes it.
            above: the path of the dataclass that has the field.
        """
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
            kind = None if kind in (None, NoneType) or not matches_type(value, kind) else kind
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
    """Return the part of a type that words can describe, without objects, tables and nested tuples; None if
    nothing is left."""
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
    """Flags that decide which other flags exist. They are parsed first."""

    map: Annotated[str | None, tyro.conf.arg(name="game.map", metavar="NAME")] = None
    """A board by its name: single_basic, single_complex, two_complex or commons."""
    agents: int | None = None
    """The number of agents, where all are alike. A board has its first starts then, or more of them on free
    ground around the first one."""
    institutions: Annotated[
        tuple[str, ...],
        tyro.conf.arg(name="game.institutions", metavar="NAME|FILE.json", help_behavior_hint=_hint),
    ] = ()
    """Institutions by their names, e.g. quota monitoring, with flags of their own, e.g.
    --game.institutions.quota.share 0.25; or a JSON file with a list of them as in a recipe.json; or none."""


def in_shape(experiment: "Experiment", shape: Shape) -> "Experiment":
    """Return the experiment with another board, number of agents or institutions, as the flags say."""
    from cprl.commons import maps
    from cprl.commons.game import Game

    if shape == Shape():
        return experiment
    game = experiment.game
    agents = experiment.agents
    if not isinstance(game, Game):
        raise ValueError("--game.map, --agents and --game.institutions are for games on a board of cprl")
    board = game.map if shape.map is None else maps.published(shape.map)
    if shape.agents is not None:
        board = maps.with_agents(board, shape.agents)
        agents = _as_many(agents, shape.agents)
    institutions = institutions_named(shape.institutions) if shape.institutions else game.institutions
    return replace(experiment, game=replace(game, map=board, institutions=institutions), agents=agents)


def _as_many(specs: "tuple[AgentSpec, ...]", agents: int) -> "tuple[AgentSpec, ...]":
    """Return the specifications of another number of agents; refuse agents that are not alike."""
    from cprl.population import Team

    first = specs[0]
    if len(specs) == 1 and isinstance(first, Team):
        return (replace(first, agents=tuple(range(agents))),)
    if isinstance(first, Team) or any(spec != first for spec in specs):
        raise ValueError(
            f"--agents is {agents}; allowed: where all agents are alike, which they are not here"
        )
    return (first,) * agents


def institutions_named(words: Sequence[str], flag: str = "--game.institutions") -> "tuple[Institution, ...]":
    """Return institutions by name, or from JSON files; ["none"] means no institution.

    Args:
        words: names, with settings in place of the defaults if any follow, as quota:share=0.5,fine=1; and
        files.
        flag: the flag in messages.
    """
    from cprl.institutions import Institution
    from cprl.values import KINDS, build, from_config

    kinds = {_snake(name): kind for name, kind in KINDS.items() if issubclass(kind, Institution)}
    institutions: list[Institution] = []
    if list(words) == ["none"]:
        return ()
    for word in words:
        name, _, settings = word.partition(":")
        kind = kinds.get(name.replace("-", "_"))
        if word.endswith(".json"):
            content = json.loads(Path(word).read_text(encoding="utf-8"))
            tables = content if isinstance(content, list) else [content]
            for number, table in enumerate(tables):
                institutions.append(from_config(table, f"{word}[{number}]"))
        elif kind is None:
            raise ValueError(f"{flag} is {name}; allowed: {', '.join(sorted(kinds))}, a file .json, or none")
        else:
            try:
                institutions.append(build(kind, _settings(settings), name))
            except ValueError as error:  # without an argument that has no default
                cure = "" if settings else "; allowed: a file .json"
                raise ValueError(f"{flag} is {word}: {error}{cure}") from error
    return tuple(institutions)


def _settings(text: str) -> dict[str, Any]:
    """Return the fields in a text such as "share=0.5,fine=1"."""
    pairs = [pair.partition("=") for pair in text.split(",") if pair]
    settings: dict[str, Any] = {}
    for name, _, value in pairs:
        try:
            settings[name.replace("-", "_")] = json.loads(value)
        except ValueError:
            settings[name.replace("-", "_")] = value
    return settings


def _snake(name: str) -> str:
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower()


def with_groups(experiment: "Experiment", flags: Sequence[str]) -> "Experiment":
    """Return the experiment with the groups of rules that the flags need.

    A group of rules, e.g. `Rules.random_end`, is None by default. A flag for one of its fields, such as
    `--game.rules.random-end.prob 0.15`, needs the group to exist before tyro reads the flags.
    """
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
    """Return a group of rules; refuse unknown fields, and required fields that no flag sets."""
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
    return kind(**dict.fromkeys(required, 1))  # placeholders, which the flags replace


def shape_of(experiment: "Experiment") -> Shape:
    """Return the shape of an experiment, for the defaults that help shows."""
    from cprl.commons import maps
    from cprl.commons.game import Game

    game = experiment.game
    if not isinstance(game, Game):
        return Shape()
    names = [name for name in maps.NAMES if maps.published(name) == game.map]
    board = next(iter(names), "as drawn")
    return Shape(map=board, agents=game.agents, institutions=tuple(_kinds(experiment)))


def with_numbers(words: Sequence[str], experiment: "Experiment") -> list[str]:
    """Return the words with indices for the names of institutions.

    For example, `--game.institutions.quota.share` becomes `--game.institutions.0.share`.
    """
    above = "--game.institutions."
    kinds = _kinds(experiment)
    changed = []
    for word in words:
        name, dot, field = word.removeprefix(above).partition(".")
        kind = name.replace("-", "_")
        if word.startswith(above) and kinds.count(kind) == 1:
            word = f"{above}{kinds.index(kind)}{dot}{field}"
        changed.append(word)
    return changed


def _kinds(experiment: "Experiment") -> list[str]:
    return [_snake(type(part).__name__) for part in getattr(experiment.game, "institutions", ())]
