"""Comments of exported files: a text of any origin in them stays a comment, for the compilers and readers themselves."""

import random
import subprocess
import xml.etree.ElementTree as ET
import zipfile

import pytest
import tree_sitter_iec61131_3_st
from small_study import small_study
from tree_sitter import Language, Parser

import jaxbl
from jaxbl.exports.c import C_MARKS
from jaxbl.exports.mjcf import _add_comments
from jaxbl.exports.writer import write_comment

# what ends a comment in one of the languages, at once or after lines are joined, letters replaced or blanks taken out
ENDERS = [
    "*/", "**/", "*/*/", "*\\\n/", "*\\\\\n/", "*\\ \n/", "*\\\r\n/", "*\\\r/", "*??/\n/", "*???/\n/", "*??/\r\n/",
    "*éé/\n/",
    "*\u2028/", "*\x00/", "*\x0b/", "//\\", "/*", "/*/", "??/", "*)", "**)", "(*)", "(*", "*\n)", "*\\\n)",
    "-->", "--->", "--!>",
    "-\n->", "\x1b", "\ufffe", "\\", "*", "-", "%>", "\u202e/*", "*\u200b/",
]  # fmt: skip
LETTERS = "*/\\?()->\n\r\v é\u2028"
C_PAYLOAD, ST_PAYLOAD = "int leaked[-1];", "END_IF;"


def draw_titles(count):
    """Texts of letters that begin and end comments, each followed by what fails where it is code."""
    letters = random.Random(46)
    drawn = ["".join(letters.choices(LETTERS, k=letters.randint(1, 7))) for _ in range(count)]
    return [*ENDERS, *drawn]


def compile_c(text):
    """Compile C as strictly as it can be; its fault, or ""."""
    command = ["gcc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-xc", "-"]
    return subprocess.run(command, input=text.encode(), capture_output=True, check=False).stderr.decode()


def read_st(text):
    """The kinds of the parts of structured text."""
    return {
        node.type for node in Parser(Language(tree_sitter_iec61131_3_st.language())).parse(text.encode()).root_node.children
    }


@pytest.mark.program("gcc")
def test_no_text_leaves_a_comment_of_c(repeats):
    titles = draw_titles(repeats(300, 20_000))
    comments = [write_comment(C_MARKS, f"From ({title}{C_PAYLOAD}),", title, "the end") for title in titles]
    assert all(comment.isascii() and comment.count("\n") == 2 for comment in comments)
    assert compile_c("\n".join([*comments, "int kept;", ""])) == ""
    assert "leaked" in compile_c(f"/* *\\\n/ {C_PAYLOAD} /* */\n")  # the check itself can fail


def test_no_text_leaves_a_comment_of_structured_text(repeats):
    for title in draw_titles(repeats(300, 5000)):
        assert read_st(write_comment(("(*", "*)"), f"From ({title}{ST_PAYLOAD}),", title, "the end")) == {"comment"}, repr(
            title
        )
    assert read_st(f"(* *) {ST_PAYLOAD} (* *)") != {"comment"}


def test_no_text_leaves_a_comment_of_xml(repeats):
    root = ET.Element("mujoco")
    _add_comments(root, *draw_titles(repeats(300, 5000)))
    assert not list(ET.fromstring(ET.tostring(root, encoding="unicode")))


@pytest.mark.program("gcc")
@pytest.mark.parametrize("target", ["c", "st", "fmu", "mjcf"])
def test_a_title_is_no_code(tmp_path, target):
    title = "".join(
        f"{ender} {ST_PAYLOAD if target == 'st' else C_PAYLOAD} " for ender in ("*\\\n/", "*??/\n/", "*)", "-->\n")
    )
    jaxbl.export(small_study(title=title), tmp_path, target, name=None if target == "mjcf" else "drive")
    if target == "fmu":
        with zipfile.ZipFile(tmp_path / "drive.fmu") as archive:
            archive.extractall(tmp_path)
        description = ET.parse(tmp_path / "modelDescription.xml").getroot().attrib["description"]
        assert description.isprintable()
    if target in ("c", "fmu"):
        for path in tmp_path.rglob("drive*.c"):
            assert compile_c(f'#include "{path}"\n') == ""
    elif target == "st":
        assert read_st((tmp_path / "drive.st").read_text()) == {"comment", "function_block_declaration"}
    else:
        ET.parse(tmp_path / "model.xml")
