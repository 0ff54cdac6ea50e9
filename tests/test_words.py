"""Plain words: messages, helps, docstrings and pages use the field's terms, and identifiers American spelling.

The list and the reasons are in CONTRIBUTING, "How we write"; docs/wording.md has examples.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for folder in ("mambaloc", "tools") for path in (ROOT / folder).rglob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = {"wording.md"}  # quotes the words that it replaces

INSTEAD = {
    r"told": "given, known, recorded",
    r"tells?|telling": "show, state, distinguish, estimate",
    r"said": "stated, given; message",
    r"anew": "again",
    r"likewise": "also, the same, or repeat what is meant",
    r"(?:is|are|be) (?-i:none)": "does not exist, is not one; or a sentence with 'no'",
    # "most of them" is plain English; "what was left out of them" leaves the noun out.
    r"(?!(?:one|two|all|some|half|none|each|many|most|several|both|any|more|few|first|part|which)\b)[a-z]+ of them": (
        "repeat the noun"
    ),
    r"(?<!there )(?:is|are|was|were|be) no (?!longer|more|less|\w+er\b|worse)\w+": "is not a",
    r"holds? no|holds? none": "has no, contains no",
    r"pictures?|photographs?": "image",
    r"(?:an?|the|of|this|each|every|any|or|and|no|one|in|with) films?|films": "video",
    r"lacks?|lacking": "has no, is missing",
    r"nobody": "no one, nothing; or name who",
    r"mend|mends|mended": "repair, correct",
    r"errs?": "is wrong, has an error",
    r"(?<!or )no whole": "truncated, damaged",
    r"for want of": "without",
}
WORDS = {word: re.compile(rf"\b(?:{word})\b", re.IGNORECASE) for word in INSTEAD}
ANY = re.compile("|".join(rf"\b(?:{word})\b" for word in INSTEAD), re.IGNORECASE)
CODE = re.compile(r"``.*?``|`[^`]*`|data\.\w+(?: to|:) \w+|^ +\w+: ", re.DOTALL | re.MULTILINE)
"""What is not prose: code, an option with its value, and the name that starts an argument's entry."""

BRITISH = re.compile("localis|normalis|colour|centre|discretis|summaris|quantis|recognis", re.IGNORECASE)
OLD_SPELLINGS = {
    "discretisation": "a hyperparameter in recipes, checkpoints and manifests",
    "normalise_position": "likewise",
    "localiser": "a deprecated module",
    "localisation": "a deprecated module",
    "localise": "deprecated",
    "localise_each": "deprecated",
    "normalise": "deprecated",
}

NAMES = {
    "told": "what it holds, such as content, settings, camera",
    "said": "what it holds, such as message, notes, summary",
    "tell": "report, write, describe",
    "tells": "report, write, describe",
    "says": "has, states, or what it holds",
    "picture": "image",
    "pictures": "images",
    "film": "video",
    "films": "videos",
    "alike": "same, similar, equal",
    "apart": "distance, difference, baseline",
    "anew": "again",
    "borne": "carried, kept",
    "quieten": "configure_logging",
    "most": "max",
    "least": "min",
}
"""Words that no identifier contains, with what to write instead."""

OLD_NAMES = {
    "apart": "deprecated",
    "pictures": "a limit of serving.Limits, and a metric",
    "most": "an argument of add_frames",
    "most_bytes": "a key of maps' recipes",
    "least_inliers": "a key of maps' recipes",
    "most_useful": "the superlative",
    "_on_most_frames": "the superlative",
    "at_most_one": "the words that bound a number",
    "at_least_near_m": "the words that bound a number",
}


def findings(text: str) -> list[str]:
    """Each word of the list in a text, with what to write instead."""
    prose = " ".join(CODE.sub("", text).split())  # phrases go on over the ends of lines
    if not ANY.search(prose):
        return []
    return [f"{found[0]!r}: write {INSTEAD[word]}" for word, rule in WORDS.items() for found in rule.finditer(prose)]


@cache
def tree_of(path: Path) -> ast.Module:
    """A source file, parsed once."""
    return ast.parse(path.read_text(encoding="utf-8"))


def strings(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of string literals that are prose; an f-string is one text, without its fields."""
    if isinstance(node, ast.JoinedStr):
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
        if " " in text.strip():
            yield node.lineno, text
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                yield from strings(part.value)
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, str) and " " in node.value.strip():
            yield node.lineno, node.value
    else:
        for child in ast.iter_child_nodes(node):
            yield from strings(child)


def prose_lines(page: str) -> Iterator[tuple[int, str]]:
    """Number and text of a page's lines outside code blocks."""
    is_code = False
    for number, line in enumerate(page.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            is_code = not is_code
        elif not is_code:
            yield number, line


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Names of functions, classes and arguments, and what ``__all__`` lists."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Assign) and any(getattr(each, "id", "") == "__all__" for each in node.targets):
            yield from ((node.lineno, name) for name in ast.literal_eval(node.value))


def assigned(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Names of variables and attributes, where they are assigned, and of imports as others."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr
        elif isinstance(node, ast.alias) and node.asname:
            yield node.lineno, node.asname


def words_of(name: str) -> list[str]:
    """The words of an identifier, in lower case."""
    return [word.lower() for word in re.findall("[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


def _reported(path: Path, number: int, found: list[str]) -> list[str]:
    return [f"{path.relative_to(ROOT)}:{number}: {each}" for each in found]


def test_messages_and_docstrings_use_plain_words():
    found = [
        line
        for path in SOURCES
        for number, text in strings(tree_of(path))
        for line in _reported(path, number, findings(text))
    ]
    assert not found, "\n" + "\n".join(found)


def test_pages_use_plain_words():
    found = []
    for path in PAGES:
        if path.name in EXAMPLES:
            continue
        for number, line in prose_lines(path.read_text(encoding="utf-8")):
            found += _reported(path, number, findings(line))
    assert not found, "\n" + "\n".join(found)


def test_identifiers_are_american():
    found = []
    for path in SOURCES:
        names = [(1, path.stem), *identifiers(tree_of(path))]
        found += [
            f"{path.relative_to(ROOT)}:{number}: {name}"
            for number, name in names
            if BRITISH.search(name) and name not in OLD_SPELLINGS
        ]
    assert not found, "\n" + "\n".join(found)


def test_identifiers_use_plain_words():
    found = []
    for path in SOURCES:
        tree = tree_of(path)
        for number, name in [(1, path.stem), *identifiers(tree), *assigned(tree)]:
            words = [] if name in OLD_NAMES else [word for word in words_of(name) if word in NAMES]
            found += _reported(path, number, [f"{name}: write {NAMES[word]}" for word in words])
    assert not found, "\n" + "\n".join(found)


def test_words_of_identifiers_are_found_where_they_are_given():
    source = "import a as film\ndef f(told, *, said_m=0):\n    self.picture = MOST_X = untold = 1\nclass ATell: ..."
    names = [name for _, name in [*identifiers(ast.parse(source)), *assigned(ast.parse(source))]]
    found = {name for name in names if {*words_of(name)} & {*NAMES}}
    assert found == {"film", "told", "said_m", "picture", "MOST_X", "ATell"}
    assert words_of("MapLocalizer_BND2") == ["map", "localizer", "bnd"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lacks seed; nothing is told without where it came from", ["told", "lacks"]),
        ("is no mapping; publish the model anew", ["anew", "is no mapping"]),
        ("there is no such model, and it is no longer needed", []),
        ("``pictures`` is a key of the answer", []),
        ("film slowly: a film of 35 mm", ["a film"]),
        ("retold, saidst, unlikewise", []),
    ],
)
def test_the_list_finds_words_and_leaves_plain_english(text, words):
    assert [line.split(":")[0].strip("'") for line in findings(text)] == words


def test_strings_are_found_where_they_are():
    tree = ast.parse('def f(x):\n    """Say it."""\n    raise E(f"{x}: holds " f"no {x!r} of them")\nkey = "told"\n')
    assert list(strings(tree)) == [(2, "Say it."), (3, "…: holds no … of them")]
