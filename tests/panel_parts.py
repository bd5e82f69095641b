"""Parts of panels in tests: by name and by kind."""


def names_of(*panels):
    """Names of all that has one, each once, as a legend has them."""
    parts = [part for panel in panels for part in panel.parts]
    names = [getattr(part, "name", "") for part in parts]
    return list(dict.fromkeys(filter(None, names)))


def part_named(panel, name):
    """The first part of a panel whose name begins like that."""
    return next(part for part in panel.parts if getattr(part, "name", "").startswith(name))


def parts_of(panel, kind):
    """Parts of one kind."""
    return [part for part in panel.parts if isinstance(part, kind)]


def texts_of(panel):
    """Words beside points."""
    return [text for part in panel.parts for text in getattr(part, "texts", ())]
