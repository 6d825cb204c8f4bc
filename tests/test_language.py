"""The dialect of the first versions stays out of docs, docstrings, comments and messages."""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TERMS = {
    r"anew": "again, re-...",
    r"astray": "diverged",
    r"beforehand": "in advance, a priori",
    r"begun": "started",
    r"dealt out": "sharded, distributed",
    r"makes? good for": "compensates",
    r"\w*manyeth": "every n-th",
    r"mend(s|ed|ing)?": "fix, correct, cure",
    r"no doubt|doubts": "warnings",
    r"flaws?": "validation error",
    r"spoil(s|t|ed)?": "corrupt, invalid",
    r"upstairs|downstairs": "a layer above, below",
    r"wander(s|ed|ing)": "drift",
    r"whoever|somebody": "a subject with a name",
    r"(is|are|was|were|be) told": "reported, given",
}
DIALECT = re.compile(rf"\b({'|'.join(f'(?:{term})' for term in TERMS)})\b", re.IGNORECASE)
# A docstring begins with a verb or a noun.
FIRST_WORDS = re.compile(r"(What|Whether|Of|By|Those|That|Who|The same|As|All that)\b")
SOURCES = [path for folder in ("jaxphoto", "jaxphoto_command") for path in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def texts_of(path):
    """Line and text of every comment and string of a module."""
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)):
            yield token.start[0], re.sub(r"`[^`]*`", "", token.string)


def prose_of(path):
    """Line and text of a page, without code."""
    text = re.sub(
        r"```.*?```", lambda code: "\n" * code.group().count("\n"), path.read_text(encoding="utf-8"), flags=re.S
    )
    return enumerate((re.sub(r"`[^`]*`", "", line) for line in text.splitlines()), 1)


def dialect_in(path):
    read = prose_of if path.suffix == ".md" else texts_of
    return [
        f"{path.relative_to(ROOT)}:{k}: {word.group()}" for k, text in read(path) for word in DIALECT.finditer(text)
    ]


@pytest.mark.parametrize("paths", [SOURCES, PAGES], ids=["sources", "pages"])
def test_terms_of_the_field_instead_of_dialect(paths):
    assert not [hit for path in paths if path.name != "migration.md" for hit in dialect_in(path)]


def test_docstrings_begin_with_a_verb_or_a_noun():
    hits = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and FIRST_WORDS.match(
                ast.get_docstring(node) or ""
            ):
                hits.append(f"{path.relative_to(ROOT)}: {getattr(node, 'name', '')}")
    assert not hits


def test_a_dialect_word_is_found(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "one.py").write_text('"""Mend it."""\nanew = f"{1} was told"  # `anew` in code\n')
    (tmp_path / "one.md").write_text("`anew`\n```\nmend\n```\nAnew.\n")
    assert dialect_in(tmp_path / "one.py") == ["one.py:1: Mend", "one.py:2: was told"]
    assert dialect_in(tmp_path / "one.md") == ["one.md:5: Anew"]
