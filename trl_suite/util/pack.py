"""Named tuples of arrays and numbers that are passed to compiled functions as one pointer.

Numba passes every element of a tuple as separate arguments: sixty arrays are four hundred
arguments, which take seconds to compile for every function, and 30 us for every call from Python. A
pack is the address of a memory block that describes the arrays as Numba does; compiled functions
read from it the fields that they use, by the names of the tuple. The pack is read-only; the arrays
may be writable.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import typeof, types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)

_WORD = 8  # bytes; a block consists of words of this size
# `typeof` takes longer than all else.
_array_types: dict[tuple[np.dtype, int, int], types.Type] = {}


class Field(NamedTuple):
    """A field of a pack: its name, its type, and its offset in the block, in words."""

    name: str
    type: types.Type
    word: int


class PackType(types.Type):
    """Numba's type of a pack: names, types and offsets of its fields."""

    def __init__(self, name: str, fields: tuple[Field, ...]) -> None:
        self.fields = {field.name: field for field in fields}
        inside = ', '.join(f'{field.name}: {field.type}' for field in fields)
        super().__init__(name=f'Pack {name}({inside})')


class Pack:
    """A memory block that describes the values of a named tuple, which it keeps alive.

    Attributes:
      address: address of the memory block.
      numba_type: see `PackType`.
    """

    __slots__ = ('_block', '_value', 'address', 'numba_type')

    def __init__(self, value: Any) -> None:
        """Packs a named tuple.

        Args:
          value: a named tuple whose fields are arrays, numbers, such tuples, or None.
        """
        words: list[bytes] = []
        self.numba_type = _describe(value, type(value).__name__, words)
        self._block = np.frombuffer(b''.join(words), np.uint64).copy()
        self._value, self.address = value, self._block.ctypes.data


def _describe(value: Any, path: str, words: list[bytes]) -> PackType:
    """Appends the block of a named tuple to `words`; returns its type."""
    begin, fields = len(words), []
    for name, entry in zip(value._fields, value, strict=True):
        word = len(words) - begin
        found: types.Type
        if isinstance(entry, np.ndarray):
            kind = entry.dtype, entry.ndim, entry.flags.num
            found = _array_types.get(kind) or _array_types.setdefault(kind, typeof(entry))
            # No owner and no reference count: the pack keeps the array alive.
            sizes = entry.size, entry.itemsize, entry.ctypes.data
            numbers = (0, 0, *sizes, *entry.shape, *entry.strides)
            words += [struct.pack('=q', number) for number in numbers]
        elif isinstance(entry, bool | int | np.bool_ | np.integer):
            found = types.int64
            words.append(struct.pack('=q', int(entry)))
        elif isinstance(entry, float | np.floating):
            found = types.float64
            words.append(struct.pack('=d', float(entry)))
        elif isinstance(entry, tuple) and hasattr(entry, '_fields'):
            found = _describe(entry, f'{path}.{name}', words)
        elif entry is None:
            found = types.none
        else:
            raise TypeError(
                f'{path}.{name} is {type(entry).__name__}; expected an array, a number, None, or a '
                'named tuple of these'
            )
        fields.append(Field(name, found, word))
    return PackType(type(value).__name__, tuple(fields))


register_model(PackType)(models.OpaqueModel)


@typeof_impl.register(Pack)
def _type_of(value: Pack, context: Any) -> PackType:
    return value.numba_type


@unbox(PackType)
def _unbox(type_: PackType, value: Any, c: Any) -> NativeValue:
    attribute = c.pyapi.object_getattr_string(value, 'address')
    address = c.pyapi.long_as_ulonglong(attribute)
    c.pyapi.decref(attribute)
    return NativeValue(c.builder.inttoptr(address, c.context.get_value_type(type_)))


@infer_getattr
class _Attributes(AttributeTemplate):
    key = PackType

    def generic_resolve(self, type_: PackType, name: str) -> Any:  # type: ignore[override]
        field = type_.fields.get(name)
        return None if field is None else field.type


@lower_getattr_generic(PackType)
def _read(context: Any, builder: Any, type_: PackType, pack: Any, name: str) -> Any:
    field = type_.fields[name]
    place = builder.gep(pack, [ir.IntType(64)(_WORD * field.word)])
    if isinstance(field.type, PackType):
        return place
    if field.type is types.none:
        return context.get_dummy_value()
    return _load(builder, place, context.get_value_type(field.type))


def _load(builder: Any, place: Any, kind: Any) -> Any:
    """Loads words one by one, so that the compiler can remove the loads of unused ones."""
    if isinstance(kind, ir.LiteralStructType | ir.ArrayType):
        elements = (
            kind.elements if isinstance(kind, ir.LiteralStructType) else [kind.element] * kind.count
        )
        value = ir.Constant(kind, ir.Undefined)
        for k, element in enumerate(elements):
            words = element.count if isinstance(element, ir.ArrayType) else 1
            value = builder.insert_value(value, _load(builder, place, element), k)
            place = builder.gep(place, [ir.IntType(64)(_WORD * words)])
        return value
    found = builder.load(builder.bitcast(place, kind.as_pointer()))
    # Blocks are constant: the compiler need not reload them after a store to an array.
    found.set_metadata('invariant.load', builder.module.add_metadata([]))
    return found
