"""Tutorial pages as notebooks: the site runs their blocks once, in order, and shows what they print and draw."""

import re

from nbformat import NotebookNode, v4

_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```\n", re.S | re.M)


def read_page(text: str, name: str, study: str = "") -> NotebookNode:
    """Read a Markdown page as a notebook.

    Blocks of `python`, and of `sh` that begin with `jaxbl`, become cells. A TOML block becomes the file that its first line
    names (`# NAME.toml`), others are appended to the file `study`. An `output` block is left out, as the cell before it has
    the true output. All other text, blocks included, stays as it is. The page called `name` links to its notebook.
    """
    cells, written, end = [], set(), 0

    def add_text(start: int) -> None:
        if (prose := text[end:start].strip()) != "":
            cells.append(v4.new_markdown_cell(prose))

    for block in _BLOCK.finditer(text):
        language, code = block.groups()
        metadata = {}
        if language == "toml":
            named = re.match(r"# (\w+\.toml)\n", code)
            file = named[1] if named else study
            code = f"%%writefile {'-a ' * (file in written)}{file}\n{code}"
            written.add(file)
            metadata = {"tags": ["remove-output"]}
        elif language == "sh" and code.startswith("jaxbl "):
            code = f"%%sh\n{code}"
        elif language not in ("python", "output"):
            continue
        add_text(block.start())
        end = block.end()
        if language != "output":
            cells.append(v4.new_code_cell(code.rstrip("\n"), metadata=metadata))
    add_text(len(text))
    heading, _, prose = cells[0].source.partition("\n")
    cells[0].source = f"{heading}\n\nThis page as a notebook: {{nb-download}}`{name}.ipynb`.\n{prose}"
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return v4.new_notebook(cells=cells, metadata={"kernelspec": kernel, "language_info": {"name": "python"}})
