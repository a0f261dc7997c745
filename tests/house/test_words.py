"""Statements do one thing, docstrings are sentences, names say one thing: read from the source itself."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

import cprl

SOURCE = Path(cprl.__file__).parent
MODULES = {path: ast.parse(path.read_text()) for path in sorted(SOURCE.rglob("*.py"))}
"""The syntax tree of each module, by its path."""
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
NO_COMMAND = re.compile(
    "The|An?|What|Whether|How|Where|When|Whom?|Which|Of|That|Those|These|This|As|In|For|By|With|Likewise|One|Each|"
    "Every|All|Both|From|To|Its?|If|Not?|Some|Several|Two|Three|Same"
)
"""First words of a text that is no command: "What of a table is compared." tells nobody what a call does."""
REPLACED = {
    "seat": "agent",
    "sitter": "agent",
    "manner": "scripted policy",
    "door": "adapter",
    "keeper": "checkpointer",
    "visitor": "focal agent",
    "visitors": "focal agents",
    "slope": "gradient",
    "chance": "rng or a probability",
    "chances": "probs or log_probs",
    "told": "the thing itself",
    "who": "agents",
    "mine": "the thing itself",
    "nth": "number or index",
    "own": "the thing itself",
}
"""Names that the house replaced, each with the word of the field that it uses instead."""
SEAT = "seat: say agent"
"""What may be said of cprl.web, where a seat is a person's place in a hosted game."""
SEVERAL_HOMES_AT_MOST = 20
"""Public names that several modules define: institutions have the same parts each, and a command is called as
the function that it calls."""
NAMED_ALIKE_AT_MOST = 12
"""Modules that have another's name: an algorithm, its loss and its learner are called alike."""


def pairs(tree):
    """Yield each `a, b = x, y` that is no swap."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign):
            continue
        target, value = node.targets[0], node.value
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            written = sorted(map(ast.unparse, target.elts))
            if written != sorted(map(ast.unparse, value.elts)):
                yield node.lineno, ast.unparse(node)


def nested_comprehensions(tree):
    """Yield each comprehension that holds another."""
    for node in ast.walk(tree):
        inner = (part for part in ast.walk(node) if part is not node)
        if isinstance(node, COMPREHENSIONS) and any(isinstance(part, COMPREHENSIONS) for part in inner):
            yield node.lineno, ast.unparse(node)


def docstrings_that_are_no_commands(tree):
    """Yield the first line of each function's docstring that begins with no verb in its plain form."""
    for node in ast.walk(tree):
        text = ast.get_docstring(node) if isinstance(node, FUNCTIONS) else None
        if not text:
            continue
        first = re.split(r"[^A-Za-z]", text, maxsplit=1)[0]
        if NO_COMMAND.fullmatch(first) or re.search(r"[^s]s$", first):
            yield node.lineno, text.splitlines()[0]


def names(tree):
    """Yield each name that a module binds: functions, classes, parameters, variables, attributes."""
    for node in ast.walk(tree):
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


def names_that_begin_with_of(tree):
    """Yield each name that begins with `of_` instead of the noun."""
    for line, name in names(tree):
        if re.match(r"_?of_", name, re.IGNORECASE):
            yield line, name


def replaced_words(tree):
    """Yield each name that is a replaced word, with the word of the field."""
    for line, name in names(tree):
        word = name.strip("_").lower()
        if word in REPLACED:
            yield line, f"{name}: say {REPLACED[word]}"


EXAMPLES = {
    pairs: ("rows, columns = 3, 4", "rows, columns = columns, rows\nrows, columns = board.shape"),
    nested_comprehensions: ("[[x for x in row] for row in rows]", "[f(row) for row in rows]"),
    docstrings_that_are_no_commands: (
        'def f():\n    "What a table holds."\n\ndef g():\n    "Returns a table."',
        'def f():\n    "Return a table."\n\ndef g():\n    "Pass on a table."',
    ),
    names_that_begin_with_of: ("def of_agents(): ...\nOF_CPRL = 3", "def agents_of(run): ..."),
    replaced_words: ("def f(own): ...\nclass Keeper: ...", "def f(owner, by_chance): ..."),
}
"""For each rule code that breaks it, once in every line that counts, and code that keeps it."""


@pytest.mark.parametrize("rule", EXAMPLES, ids=lambda rule: rule.__name__)
def test_no_module_breaks_a_rule_of_statements_and_words(rule):
    breaks = [
        f"{path.relative_to(SOURCE)}:{line}: {text}"
        for path, tree in MODULES.items()
        for line, text in rule(tree)
        if path.parent.name != "web" or text.lower() != SEAT
    ]
    assert breaks == []


@pytest.mark.parametrize("rule", EXAMPLES, ids=lambda rule: rule.__name__)
def test_a_rule_notices_what_breaks_it_and_nothing_else(rule):
    broken, kept = map(ast.parse, EXAMPLES[rule])
    assert len(list(rule(broken))) == len(broken.body)
    assert list(rule(kept)) == []


def public_names(tree):
    """Yield the public names that a module defines at its top."""
    for node in tree.body:
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            defined = [node.name]
        else:
            targets = getattr(node, "targets", [getattr(node, "target", None)])
            defined = [target.id for target in targets if isinstance(target, ast.Name)]
        yield from (name for name in defined if not name.startswith("_"))


def test_a_public_name_has_one_home_with_few_exceptions():
    homes = defaultdict(set)
    for path, tree in MODULES.items():
        for name in public_names(tree):
            homes[name].add(str(path.relative_to(SOURCE)))
    several = {name: sorted(modules) for name, modules in homes.items() if len(modules) > 1}
    assert len(several) <= SEVERAL_HOMES_AT_MOST, several
    assert set(homes["parameters"]) > {"institutions/quotas.py", "institutions/taxes.py"}, (
        "the names are read"
    )


def test_a_module_has_a_name_of_its_own_with_few_exceptions():
    modules = defaultdict(list)
    for path in MODULES:
        if path.name != "__init__.py":
            modules[path.stem].append(str(path.relative_to(SOURCE)))
    alike = [path for paths in modules.values() if len(paths) > 1 for path in paths]
    assert len(alike) <= NAMED_ALIKE_AT_MOST, alike
    assert {"algorithms/lola.py", "learners/lola.py"} <= set(alike), "the modules are read"
