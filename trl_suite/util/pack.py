"""A tuple of arrays that enters compiled functions as one pointer.

Numba takes a tuple apart whenever it is passed from Python, about half a microsecond for each array:
for a single environment that is more than the rules themselves take. A pack is taken apart once.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.experimental import structref

from trl_suite.util.compiled import Compiled, compiled_loop


@structref.register
class PackType(types.StructRef):
    """Numba's type of a pack."""


class Pack(structref.StructRefProxy):
    """A value for compiled functions, which read `pack.value`."""

    def __new__(cls, value: Any) -> Pack:
        return structref.StructRefProxy.__new__(cls, value)


structref.define_proxy(Pack, PackType, ['value'])


@compiled_loop
def pack(value: Any) -> Pack:
    """Returns a pack of a value."""
    return Pack(value)


# Numba writes down the types for which it has compiled a function, and reads all of them in every
# process. Types of other packages must not be among them: they cannot be imported everywhere.
pack_foreign = Compiled(pack.function, counted=True, kept=False)
