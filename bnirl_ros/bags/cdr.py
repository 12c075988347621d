"""Messages to and from CDR, the bytes in which DDS and bags carry them."""

from __future__ import annotations

import struct
from typing import ClassVar, Protocol

from bnirl_ros.bags.definitions import full_type_name, typestore_with
from bnirl_ros.errors import InputError


class Message(Protocol):
    """Anything with a message type's name and its fields as attributes.

    Nested messages need only their fields; sequences of numbers are numpy arrays of the field's
    element type.
    """

    TYPE: ClassVar[str]


def encode(message: Message) -> bytes:
    """Little-endian CDR of a message, with its four bytes of encapsulation header.

    Raises:
        InputError: the message's type is unknown.
        ValueError: a field is missing, or its value doesn't fit its type.
    """
    from rosbags.serde import SerdeError

    store = typestore_with(message.TYPE)
    try:
        return bytes(store.serialize_cdr(message, message.TYPE, little_endian=True))
    except (SerdeError, struct.error, AttributeError, TypeError, ValueError) as fault:
        raise ValueError(f"This {message.TYPE} cannot be encoded: {fault}") from fault


def decode(type_name: str, data: bytes) -> object:
    """The message in CDR bytes of either byte order: an object with the type's fields.

    Raises:
        InputError: the type is unknown, or the bytes are no message of it.
    """
    from rosbags.serde import SerdeError

    name = full_type_name(type_name)
    store = typestore_with(name)
    try:
        return store.deserialize_cdr(data, name)
    except (SerdeError, struct.error, ValueError, IndexError, OverflowError) as fault:
        raise InputError(
            f"{len(data)} bytes are no {name} in CDR ({fault}); record the topic again, or leave "
            "it out"
        ) from fault
