"""A package with entry points, as `pip install` would leave it in a folder."""

from pathlib import Path


def install_package(folder: Path, name: str, source: str, entries: dict[str, dict[str, str]]) -> None:
    """Write a module and its metadata.

    Args:
        folder: to be put on `sys.path`.
        name: of the module.
        source: its text.
        entries: group -> name of an entry -> what it names in the module.
    """
    (folder / f"{name}.py").write_text(source, encoding="utf-8")
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    lines = []
    for group, members in entries.items():
        lines += [f"[{group}]", *(f"{entry} = {name}:{member}" for entry, member in members.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
