"""Let Numba pass named tuples of arrays by reference, as records.

By default Numba passes a tuple by value. Each call of a rule would then take every array of the game's
`Worlds` and `Tables` apart into its pointer, shape and strides, some thousand numbers, which took four fifths
of the time to compile.

A record is a pointer to the arrays of a named tuple. It is valid as long as the function that made it runs.
Only the functions that drivers call make records, from their arguments and by functions of
`cprl.institutions.arrays.slicer`, and all rules become one piece of machine code with them.

In the functions below, `context` and `builder` are Numba's target context and LLVM's builder of instructions,
and a function returns the LLVM value of what its name says.
"""

import operator
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from types import FunctionType
from typing import Any, Final

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate
from numba.extending import NativeValue, infer_getattr, intrinsic, models, register_model, unbox

from cprl.values.array_types import is_record

VERSION: Final = sha256(Path(__file__).read_bytes()).hexdigest()[:16]
"""The hash of this file; compiled code depends on it, so it is part of the key of the cache."""


class Record(types.Type):
    """Numba's type of a record: the class of the named tuple, and the types of its entries."""

    def __init__(self, kind: Any, entries: Sequence[Any]) -> None:
        self.kind = kind
        self.entries = tuple(entries)
        text = f"{kind.__module__}.{kind.__qualname__} {[str(entry) for entry in entries]}"
        super().__init__(name=f"{kind.__name__}_{sha256(text.encode()).hexdigest()[:16]}")


@register_model(Record)
class _RecordModel(models.PrimitiveModel):
    """Tells Numba that a record is a pointer."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.IntType(8).as_pointer())


def type_of(value: Any) -> Any:
    """Return the type for which Numba compiles a value: `Record` for a named tuple, also inside tuples."""
    if not isinstance(value, tuple):
        return numba.typeof(value)
    entries = [type_of(entry) for entry in value]
    return Record(type(value), entries) if is_record(type(value)) else types.Tuple(entries)


_INT: Final = ir.IntType(64)
"""The type of lengths, `types.intp`."""


def _is_contiguous(kind: Any) -> bool:
    """Return whether a type is that of contiguous arrays; a record stores only their pointers and shapes."""
    return isinstance(kind, types.Array) and kind.layout == "C"


def _stored_type(context: Any, kind: Any) -> Any:
    """Return the LLVM type in which a record stores an entry."""
    if _is_contiguous(kind):
        item = context.get_data_type(kind.dtype).as_pointer()
        return ir.LiteralStructType([item, *[_INT] * kind.ndim])
    return context.get_data_type(kind)


def _struct_type(context: Any, record: Any) -> Any:
    """Return the LLVM type of the memory to which a record points."""
    return ir.LiteralStructType([_stored_type(context, entry) for entry in record.entries])


def _entry_pointer(context: Any, builder: Any, record: Any, pointer: Any, number: int) -> Any:
    """Return a pointer to an entry of a record."""
    typed = builder.bitcast(pointer, _struct_type(context, record).as_pointer())
    return cgutils.gep_inbounds(builder, typed, 0, number)


def _load_entry(context: Any, builder: Any, record: Any, pointer: Any, number: int) -> Any:
    """Return the entry of a record with this index."""
    kind = record.entries[number]
    if isinstance(kind, types.NoneType):
        return context.get_dummy_value()
    place = _entry_pointer(context, builder, record, pointer, number)
    if _is_contiguous(kind):
        return _load_array(context, builder, kind, place)
    return context.data_model_manager[kind].load_from_data_pointer(builder, place)


def _load_array(context: Any, builder: Any, kind: Any, place: Any) -> Any:
    """Return the array whose pointer and shape are stored at `place`; its strides follow from the shape."""
    stored = builder.load(place)
    data, *shape = (builder.extract_value(stored, n) for n in range(1 + kind.ndim))
    size = _INT(context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    strides = [size]
    items = shape[-1]
    for length in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], length))
    for length in shape[:-1]:
        items = builder.mul(items, length)
    model = context.data_model_manager[kind]
    array = ir.Constant(model.get_value_type(), None)
    for name, value in {"data": data, "itemsize": size, "nitems": items}.items():
        array = builder.insert_value(array, value, model.get_field_position(name))
    for name, values in {"shape": shape, "strides": strides}.items():
        for n, value in enumerate(values):
            array = builder.insert_value(array, value, [model.get_field_position(name), n])
    return array


def _new_record(context: Any, builder: Any, record: Any, values: Sequence[Any]) -> Any:
    """Return a pointer to a new record with these entries, in the memory of the function being compiled."""
    with builder.goto_entry_block():
        memory = builder.alloca(_struct_type(context, record))
    pointer = builder.bitcast(memory, ir.IntType(8).as_pointer())
    for number, (kind, value) in enumerate(zip(record.entries, values, strict=True)):
        if not isinstance(kind, types.NoneType):
            place = _entry_pointer(context, builder, record, pointer, number)
            if _is_contiguous(kind):
                position = context.data_model_manager[kind].get_field_position
                positions = [position("data"), *([position("shape"), n] for n in range(kind.ndim))]
                for n, part_position in enumerate(positions):
                    part = builder.extract_value(value, part_position)
                    builder.store(part, cgutils.gep_inbounds(builder, place, 0, n))
            else:
                builder.store(context.data_model_manager[kind].as_data(builder, value), place)
    return pointer


@infer_getattr
class _Entries(AttributeTemplate):
    """Tells Numba the types of a record's entries."""

    key = Record

    def generic_resolve(self, record: Any, name: str) -> Any:  # type: ignore[override]
        fields = record.kind._fields
        return record.entries[fields.index(name)] if name in fields else None


@lower_getattr_generic(Record)
def _get(context: Any, builder: Any, record: Any, pointer: Any, name: str) -> Any:
    """Return the entry of a record with this name."""
    return _load_entry(context, builder, record, pointer, record.kind._fields.index(name))


@unbox(Record)
def _unbox(record: Any, value: Any, c: Any) -> Any:
    """Return a new record with the entries of a Python tuple."""
    values = []
    failed = cgutils.alloca_once_value(c.builder, cgutils.false_bit)
    for number, kind in enumerate(record.entries):
        native = c.unbox(kind, c.pyapi.tuple_getitem(value, number))
        values.append(native.value)
        with c.builder.if_then(native.is_error, likely=False):
            c.builder.store(cgutils.true_bit, failed)
    pointer = _new_record(c.context, c.builder, record, values)
    return NativeValue(pointer, is_error=c.builder.load(failed))


@intrinsic
def local(_: Any, kind: Any) -> Any:
    """Return a copy of a value whose records are in the memory of the calling function.

    There LLVM can see that a write to an array never changes the pointer or shape of another array.
    """

    def build(target: Any, builder: Any, _: Any, values: Any) -> Any:
        return _build_local(target, builder, kind, values[0])

    return kind(kind), build


def _build_local(target: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, Record):
        entries = [_load_entry(target, builder, kind, value, number) for number in range(len(kind.entries))]
        copies = [_build_local(target, builder, *each) for each in zip(kind.entries, entries, strict=True)]
        return _new_record(target, builder, kind, copies)
    if isinstance(kind, types.Tuple):
        entries = cgutils.unpack_tuple(builder, value)
        copies = [_build_local(target, builder, *each) for each in zip(kind, entries, strict=True)]
        return target.make_tuple(builder, kind, copies)
    return value


def with_local(entry: FunctionType, compiled: Any) -> FunctionType:
    """Return a function with the name and arguments of an entry, which calls the compiled entry with `local`
    copies of its arguments."""
    arguments = entry.__code__.co_varnames[: entry.__code__.co_argcount]
    copies = ", ".join(f"local({name})" for name in arguments)
    names = {"__name__": __name__, "local": local, "compiled": compiled}
    exec(f"def {entry.__name__}({', '.join(arguments)}):\n    return compiled({copies})\n", names)
    function: FunctionType = names[entry.__name__]
    return function


def by_reference(sliced: tuple[Any, ...]) -> Any:
    """Return the compiled replacement for a function made by `slicer`, which makes a record of world b.

    Args:
        sliced: what the function does with each entry of its named tuple: True if it takes world b out of it,
            False if the entry stays as it is, and such a tuple if it is a named tuple itself.
    """

    @intrinsic
    def one(context: Any, arrays: Any, b: Any) -> Any:
        if isinstance(arrays, types.NoneType):
            return types.none(arrays, b), lambda target, *_: target.get_dummy_value()
        record = _world_type(context, sliced, arrays, b)

        def build(target: Any, builder: Any, _: Any, values: Any) -> Any:
            return _build_world(context, target, builder, sliced, arrays, record, values[0], b, values[1])

        return record(arrays, b), build

    return one


def _world_type(context: Any, sliced: tuple[Any, ...], arrays: Any, b: Any) -> Any:
    """Return the type of the record of one world, from the types of the arrays of all worlds and of b."""
    entries = []
    for kind, part in zip(arrays.entries, sliced, strict=True):
        if isinstance(part, tuple) and not isinstance(kind, types.NoneType):
            entries.append(_world_type(context, part, kind, b))
        elif part is True:
            entries.append(_getitem(context, kind, b).return_type)
        else:
            entries.append(kind)
    return Record(arrays.kind, entries)


def _getitem(context: Any, array: Any, b: Any) -> Any:
    """Return Numba's signature of `array[b]`."""
    return context.resolve_function_type(operator.getitem, (array, b), {})


def _build_world(
    context: Any,
    target: Any,
    builder: Any,
    sliced: tuple[Any, ...],
    arrays: Any,
    record: Any,
    pointer: Any,
    b: Any,
    b_value: Any,
) -> Any:
    """Return a new record of one world.

    `arrays`, `record` and `b` are types; `pointer` is the value of the arrays of all worlds, `b_value` that
    of the index b.
    """
    values = []
    for number, part in enumerate(sliced):
        kind = arrays.entries[number]
        value = _load_entry(target, builder, arrays, pointer, number)
        if isinstance(part, tuple) and not isinstance(kind, types.NoneType):
            value = _build_world(
                context, target, builder, part, kind, record.entries[number], value, b, b_value
            )
        elif part is True:
            signature = _getitem(context, kind, b)
            value = target.get_function(operator.getitem, signature)(builder, (value, b_value))
        values.append(value)
    return _new_record(target, builder, record, values)
