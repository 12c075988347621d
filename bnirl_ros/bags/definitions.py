"""The definitions of the message types: their text as bags carry it, and their type hash."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from bnirl_ros.errors import InputError
from bnirl_ros.resources import share_folder

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_TYPE_NAME = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)")
_FIELD_TYPE = re.compile(r"^[ \t]*([A-Za-z][\w/]*)", re.MULTILINE)
_PRIMITIVES = frozenset(
    {"bool", "byte", "char", "float32", "float64", "string", "wstring"}
    | {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
)
_SEPARATOR = "=" * 80


def full_type_name(name: str) -> str:
    """`package/msg/Type` for a message type also where it is written `package/Type`."""
    match = _TYPE_NAME.fullmatch(name)
    return f"{match[1]}/msg/{match[2]}" if match else name


def known_types() -> tuple[str, ...]:
    """Names of all message types whose definitions come with the package, sorted."""
    files = _schema_folder().glob("*/msg/*.msg")
    return tuple(sorted(f"{file.parts[-3]}/msg/{file.stem}" for file in files))


@cache
def message_definition(type_name: str) -> str:
    """The definition of a type and of all types in it, as one ros2msg text.

    Laid out as rosbag2 writes it into an MCAP schema: the text of the type, then that of each
    type it needs, depth first, in sorted order, each once and under a separator.

    Raises:
        InputError: the type is none of `known_types()`.
    """
    root, *needed = _closure(type_name)
    parts = [_text(root)]
    for name in needed:
        package, _, short = name.split("/")
        parts.append(f"{_SEPARATOR}\nMSG: {package}/{short}\n{_text(name)}")
    return "\n".join(parts)


@cache
def type_hash(type_name: str) -> str:
    """`RIHS01_...`, the hash by which ROS 2 tells whether two definitions are the same.

    Raises:
        InputError: the type is none of `known_types()`.
    """
    return typestore_with(type_name).hash_rihs01(full_type_name(type_name))


def typestore_with(type_name: str) -> Typestore:
    """The one store of types, with this type and the types that it needs registered.

    Only what is asked for is parsed: the store of all ROS types takes longer to load than an
    inference to run.

    Raises:
        InputError: the type is none of `known_types()`.
    """
    store = _typestore()
    missing = [name for name in _closure(type_name) if name not in store.types]
    if missing:
        from rosbags.typesys import get_types_from_msg

        store.register(
            {
                name: definition
                for wanted in missing
                for name, definition in get_types_from_msg(_text(wanted), wanted).items()
            }
        )
    return store


@cache
def _typestore() -> Typestore:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.EMPTY)


@cache
def _closure(type_name: str) -> tuple[str, ...]:
    """The type, then every type in it: depth first, in sorted order, each once."""
    found: dict[str, None] = {}

    def visit(name: str) -> None:
        if name not in found:
            found[name] = None
            for needed in _dependencies(name):
                visit(needed)

    visit(full_type_name(type_name))
    return tuple(found)


def _dependencies(name: str) -> list[str]:
    package = name.split("/")[0]
    types = set(_FIELD_TYPE.findall(_text(name))) - _PRIMITIVES
    return sorted(full_type_name(kind if "/" in kind else f"{package}/{kind}") for kind in types)


@cache
def _text(name: str) -> str:
    # The name may come from a bag: only a plain one may become part of a path.
    match = _TYPE_NAME.fullmatch(name)
    path = _schema_folder() / match[1] / "msg" / f"{match[2]}.msg" if match else None
    if path is None or not path.is_file():
        raise InputError(
            f"message type {name!r}: is unknown to bnirl_ros; leave its topic out, or take one of "
            f"{', '.join(known_types())}"
        )
    return path.read_text(encoding="utf-8")


def _schema_folder() -> Path:
    return share_folder() / "msg_schemas"
