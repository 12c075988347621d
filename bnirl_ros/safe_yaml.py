"""YAML of unknown origin: plain values only, and no more of them than were written down."""

from __future__ import annotations

from typing import Any

from bnirl_ros.errors import InputError

SIZE_LIMIT = 2**24
"""Bytes of a YAML text at most."""

_DEEPEST = 100
"""Levels of nesting; ours have six."""

_MOST_REPEATED = 100_000
"""Values that aliases may stand for in all; ours have none."""

_MOST_DIGITS = 1000
"""Of an integer. It takes time as their square to read those to the base of 60, 1:30:00, and
Python does not show a number of more than 4,300 that were read as 0xff."""


def load_yaml(text: str | bytes) -> Any:
    """The value of a YAML text, made of dicts, lists, texts, numbers, dates and nothing else.

    A few nested aliases can stand for more values than memory holds, and for one that holds
    itself; and a library that follows deep nesting may overflow the stack. Such texts are refused
    before they are loaded.

    Raises:
        InputError: it is no YAML, or asks for too much; says no more than what and where.
    """
    import yaml  # slow to import, and not everybody needs it

    if len(text) > SIZE_LIMIT:
        raise InputError(f"this YAML has more than {SIZE_LIMIT >> 20} MiB")

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        """A safe one, and quick where it can be, of integers that can be shown."""

        def construct_yaml_int(self, node: Any) -> Any:
            if len(node.value) > _MOST_DIGITS:
                raise ValueError
            return super().construct_yaml_int(node)

    Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_yaml_int)
    try:
        _check_extent(yaml, text, Loader)
        return yaml.load(text, Loader=Loader)  # noqa: S506 # a safe one
    except InputError:
        raise
    # PyYAML lets through what goes wrong with a date, or a tag such as !!bool on another word.
    except (
        yaml.YAMLError,
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise InputError(f"this is not valid YAML{place}") from None


def _check_extent(yaml: Any, text: str | bytes, loader: Any) -> None:
    """Refuse what is nested too deeply, and aliases that stand for too much."""
    sizes: dict[str, int] = {}  # of what each anchor names; 0 while it is not at its end
    open_nodes: list[tuple[str | None, int]] = []  # an anchor, and the size before what it names
    size = repeated = 0
    for event in yaml.parse(text, Loader=loader):
        if isinstance(event, yaml.AliasEvent):
            stands_for = sizes.get(event.anchor, 1)
            repeated += stands_for
            size += stands_for
            if not stands_for or repeated > _MOST_REPEATED:
                raise InputError("the aliases of this YAML stand for too much; write it out")
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, size))
            size += 1
            if event.anchor is not None:
                sizes[event.anchor] = 0
            if len(open_nodes) > _DEEPEST:
                raise InputError(f"this YAML is nested more than {_DEEPEST} levels deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = size - before
        elif isinstance(event, yaml.ScalarEvent):
            size += 1
            if event.anchor is not None:
                # A long text is repeated wherever the value is shown.
                sizes[event.anchor] = 1 + len(event.value) // 100
