"""Size and words of a Python tree, by folder: `python benchmarks/size.py [FOLDER]`, default jaxbl (`make size`).

Tokens are operators, names, numbers and strings outside of docstrings and comments: unlike lines, they do not fall when the
same code is packed more densely. The word figures are shares of names that hold no thing, of functions named by a single
participle, and of docstrings whose first sentence has neither a subject nor a verb at its head.
"""

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]

_VAGUE_NAMES = {
    *(
        "one",
        "ones",
        "found",
        "at",
        "given",
        "own",
        "known",
        "others",
        "kept",
        "rest",
        "about",
        "which",
        "tried",
        "every",
        "said",
    ),
    *(
        "whole",
        "shown",
        "why",
        "each",
        "wanted",
        "both",
        "what",
        "some",
        "side_",
        "by",
        "left_",
        "told",
        "made",
        "seen",
        "many",
    ),
    *("much", "such"),
}
_PARTICIPLES = {
    *(
        "held",
        "found",
        "said",
        "told",
        "shown",
        "kept",
        "left",
        "made",
        "begun",
        "known",
        "given",
        "drawn",
        "written",
        "sent",
    ),
    *("taken", "thrown", "led", "fed", "sought", "met"),
}
"""Those that do not end in -ed."""
_HEADS_WITHOUT_SUBJECT = {"Of", "What", "Whether", "How", "Where", "By", "As"}

_FUNCTIONS = ast.FunctionDef, ast.AsyncFunctionDef
_COUNTED_TOKENS = {tokenize.OP, tokenize.NAME, tokenize.NUMBER, tokenize.STRING}
# Python 3.12 and later split an f-string into its pieces: it counts as one token here, as it did before
_FSTRING_START = getattr(tokenize, "FSTRING_START", None)
_FSTRING_END = getattr(tokenize, "FSTRING_END", None)


@dataclass
class Size:
    """Counts of one file, or their sum over several."""

    lines: int = 0
    code_lines: int = 0
    tokens: int = 0
    names: int = 0
    vague_names: int = 0
    functions: int = 0
    participle_functions: int = 0
    docstrings: int = 0
    docstrings_without_subject: int = 0

    def __iadd__(self, other: "Size") -> "Size":
        for field, count in vars(other).items():
            setattr(self, field, getattr(self, field) + count)
        return self

    @property
    def tokens_a_line(self) -> float:
        return self.tokens / max(self.code_lines, 1)

    @property
    def vague_percent(self) -> float:
        return 100 * self.vague_names / max(self.names, 1)

    @property
    def participle_percent(self) -> float:
        return 100 * self.participle_functions / max(self.functions, 1)

    @property
    def without_subject_percent(self) -> float:
        return 100 * self.docstrings_without_subject / max(self.docstrings, 1)


def measure_file(path: Path) -> Size:
    text = path.read_text()
    tree = ast.parse(text)
    size = Size(lines=len(text.splitlines()))
    docstring_lines = _find_docstring_lines(tree)
    code_lines: set[int] = set()
    for first, last in _counted_tokens(text):
        if first not in docstring_lines:
            size.tokens += 1
            code_lines |= set(range(first, last + 1))
    size.code_lines = len(code_lines)
    _count_words(tree, size)
    return size


def _find_docstring_lines(tree: ast.Module) -> set[int]:
    """Lines of all strings that stand alone in a module, class or function."""
    lines: set[int] = set()
    for owner in ast.walk(tree):
        if isinstance(owner, (ast.Module, ast.ClassDef, *_FUNCTIONS)):
            for statement in owner.body:
                if (
                    isinstance(statement, ast.Expr)
                    and isinstance(statement.value, ast.Constant)
                    and isinstance(statement.value.value, str)
                ):
                    lines |= set(range(statement.lineno, (statement.end_lineno or statement.lineno) + 1))
    return lines


def _counted_tokens(text: str) -> Iterator[tuple[int, int]]:
    """First and last line of each token that counts."""
    fstring_starts: list[int] = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if _FSTRING_START is not None and token.type == _FSTRING_START:
            fstring_starts.append(token.start[0])
        elif _FSTRING_END is not None and token.type == _FSTRING_END:
            start = fstring_starts.pop()
            if not fstring_starts:
                yield start, token.end[0]
        elif token.type in _COUNTED_TOKENS and not fstring_starts:
            yield token.start[0], token.end[0]


def _count_words(tree: ast.Module, size: Size) -> None:
    for node in ast.walk(tree):
        name = node.id if isinstance(node, ast.Name) else node.arg if isinstance(node, ast.arg) else None
        if name is not None:
            size.names += 1
            size.vague_names += name.strip("_") in _VAGUE_NAMES
        if isinstance(node, _FUNCTIONS):
            size.functions += 1
            bare_name = node.name.strip("_")
            size.participle_functions += "_" not in bare_name and (bare_name.endswith("ed") or bare_name in _PARTICIPLES)
        if isinstance(node, (*_FUNCTIONS, ast.ClassDef)) and (docstring := ast.get_docstring(node)):
            size.docstrings += 1
            size.docstrings_without_subject += docstring.split(None, 1)[0].rstrip(",.") in _HEADS_WITHOUT_SUBJECT


def measure_folders(root: Path) -> dict[str, Size]:
    """Sizes of the folders in `root`, of the modules beside them (`.`), and their sum (`all`)."""
    sizes: dict[str, Size] = {}
    for path in sorted(root.rglob("*.py")):
        folder, *below = path.relative_to(root).parts
        size = measure_file(path)
        for name in (folder if below else ".", "all"):
            sizes.setdefault(name, Size())
            sizes[name] += size
    return sizes


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "jaxbl"
    print(f"{'':16}  lines  tokens  tokens a line  vague names  participle functions  docstrings without subject")
    for folder, size in sorted(measure_folders(root).items(), key=lambda pair: pair[1].tokens):
        print(
            f"{folder:16} {size.lines:6} {size.tokens:7} {size.tokens_a_line:14.1f} {size.vague_percent:10.2f} % "
            f"{size.participle_percent:19.1f} % {size.without_subject_percent:25.1f} %"
        )


if __name__ == "__main__":
    main()
