"""Records, named tuples of arrays, as Numba compiles them: handed on by reference.

Numba hands a tuple on by value: each call of a rule would take every array of `Worlds` and `Tables` apart
into its pointer, shape and strides, some thousand numbers, which took four fifths of the time to compile.
A record is a pointer to its arrays instead. It lasts as long as the function that made it; only entries make
some, of their arguments and by `slicer`, and all rules become one piece of code with them.
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

from cprl.institutions.arrays import Sliced, is_record

VERSION: Final = sha256(Path(__file__).read_bytes()).hexdigest()[:16]
"""Of the code in this file, on which what is compiled depends."""


class Record(types.Type):
    """The type of a record, and of the entries in it."""

    def __init__(self, kind: Any, entries: Sequence[Any]) -> None:
        self.kind, self.entries = kind, tuple(entries)
        text = f"{kind.__module__}.{kind.__qualname__} {[str(entry) for entry in entries]}"
        super().__init__(name=f"{kind.__name__}_{sha256(text.encode()).hexdigest()[:16]}")


@register_model(Record)
class _RecordModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.IntType(8).as_pointer())


def type_of(value: Any) -> Any:
    """Return the type that Numba compiles for: of records, and of tuples with records in them, ours."""
    if not isinstance(value, tuple):
        return numba.typeof(value)
    entries = [type_of(entry) for entry in value]
    return Record(type(value), entries) if is_record(type(value)) else types.Tuple(entries)


_INT: Final = ir.IntType(64)
"""Of lengths, `types.intp`."""


def _is_whole(kind: Any) -> bool:
    """Return whether a type is of arrays without gaps, of which a record keeps the pointer and the shape."""
    return isinstance(kind, types.Array) and kind.layout == "C"


def _kept(context: Any, kind: Any) -> Any:
    if _is_whole(kind):
        item = context.get_data_type(kind.dtype).as_pointer()
        return ir.LiteralStructType([item, *[_INT] * kind.ndim])
    return context.get_data_type(kind)


def _struct(context: Any, record: Any) -> Any:
    return ir.LiteralStructType([_kept(context, entry) for entry in record.entries])


def _place(context: Any, builder: Any, record: Any, pointer: Any, number: int) -> Any:
    """Return a pointer to an entry of a record."""
    typed = builder.bitcast(pointer, _struct(context, record).as_pointer())
    return cgutils.gep_inbounds(builder, typed, 0, number)


def _entry(context: Any, builder: Any, record: Any, pointer: Any, number: int) -> Any:
    kind = record.entries[number]
    if isinstance(kind, types.NoneType):
        return context.get_dummy_value()
    place = _place(context, builder, record, pointer, number)
    if _is_whole(kind):
        return _array(context, builder, kind, place)
    return context.data_model_manager[kind].load_from_data_pointer(builder, place)


def _array(context: Any, builder: Any, kind: Any, place: Any) -> Any:
    """Return the array that is kept at a place."""
    kept = builder.load(place)
    data, *shape = (builder.extract_value(kept, n) for n in range(1 + kind.ndim))
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


def _made(context: Any, builder: Any, record: Any, values: Sequence[Any]) -> Any:
    """Return a pointer to a record with these entries, in the memory of the function that is built."""
    with builder.goto_entry_block():
        made = builder.alloca(_struct(context, record))
    pointer = builder.bitcast(made, ir.IntType(8).as_pointer())
    for number, (kind, value) in enumerate(zip(record.entries, values, strict=True)):
        if not isinstance(kind, types.NoneType):
            place = _place(context, builder, record, pointer, number)
            if _is_whole(kind):
                position = context.data_model_manager[kind].get_field_position
                places = [position("data"), *([position("shape"), n] for n in range(kind.ndim))]
                for n, each in enumerate(places):
                    part = builder.extract_value(value, each)
                    builder.store(part, cgutils.gep_inbounds(builder, place, 0, n))
            else:
                builder.store(context.data_model_manager[kind].as_data(builder, value), place)
    return pointer


@infer_getattr
class _Entries(AttributeTemplate):
    key = Record

    def generic_resolve(self, record: Any, name: str) -> Any:  # type: ignore[override]
        fields = record.kind._fields
        return record.entries[fields.index(name)] if name in fields else None


@lower_getattr_generic(Record)
def _get(context: Any, builder: Any, record: Any, pointer: Any, name: str) -> Any:
    return _entry(context, builder, record, pointer, record.kind._fields.index(name))


@unbox(Record)
def _unbox(record: Any, given: Any, c: Any) -> Any:
    values = []
    failed = cgutils.alloca_once_value(c.builder, cgutils.false_bit)
    for number, kind in enumerate(record.entries):
        native = c.unbox(kind, c.pyapi.tuple_getitem(given, number))
        values.append(native.value)
        with c.builder.if_then(native.is_error, likely=False):
            c.builder.store(cgutils.true_bit, failed)
    made = _made(c.context, c.builder, record, values)
    return NativeValue(made, is_error=c.builder.load(failed))


@intrinsic
def local(_: Any, given: Any) -> Any:
    """Return what is given with its records in the memory of the function that asks, in which LLVM sees that
    no array changes where another one is."""

    def build(target: Any, builder: Any, _: Any, values: Any) -> Any:
        return _local(target, builder, given, values[0])

    return given(given), build


def _local(target: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, Record):
        entries = [_entry(target, builder, kind, value, number) for number in range(len(kind.entries))]
        copies = [_local(target, builder, *each) for each in zip(kind.entries, entries, strict=True)]
        return _made(target, builder, kind, copies)
    if isinstance(kind, types.Tuple):
        entries = cgutils.unpack_tuple(builder, value)
        copies = [_local(target, builder, *each) for each in zip(kind, entries, strict=True)]
        return target.make_tuple(builder, kind, copies)
    return value


def with_local(entry: FunctionType, compiled: Any) -> FunctionType:
    """Return a function, called like an entry, that calls the compiled entry with `local` arguments."""
    arguments = entry.__code__.co_varnames[: entry.__code__.co_argcount]
    given = ", ".join(f"local({name})" for name in arguments)
    names = {"__name__": __name__, "local": local, "compiled": compiled}
    exec(f"def {entry.__name__}({', '.join(arguments)}):\n    return compiled({given})\n", names)
    function: FunctionType = names[entry.__name__]
    return function


def by_reference(sliced: Sliced) -> Any:
    """Return what Numba takes in place of the function of a `slicer`."""

    @intrinsic
    def one(context: Any, arrays: Any, b: Any) -> Any:
        if isinstance(arrays, types.NoneType):
            return types.none(arrays, b), lambda target, *_: target.get_dummy_value()
        record = _type_of_one(context, sliced, arrays, b)

        def build(target: Any, builder: Any, _: Any, given: Any) -> Any:
            return _one(context, target, builder, sliced, arrays, record, given[0], b, given[1])

        return record(arrays, b), build

    return one


def _type_of_one(context: Any, sliced: Sliced, arrays: Any, b: Any) -> Any:
    entries = []
    for kind, part in zip(arrays.entries, sliced.parts, strict=True):
        if isinstance(part, Sliced) and not isinstance(kind, types.NoneType):
            entries.append(_type_of_one(context, part, kind, b))
        elif part is True:
            entries.append(_getitem(context, kind, b).return_type)
        else:
            entries.append(kind)
    return Record(arrays.kind, entries)


def _getitem(context: Any, array: Any, b: Any) -> Any:
    return context.resolve_function_type(operator.getitem, (array, b), {})


def _one(
    context: Any,
    target: Any,
    builder: Any,
    sliced: Sliced,
    arrays: Any,
    record: Any,
    pointer: Any,
    b: Any,
    at: Any,
) -> Any:
    values = []
    for number, part in enumerate(sliced.parts):
        kind, value = arrays.entries[number], _entry(target, builder, arrays, pointer, number)
        if isinstance(part, Sliced) and not isinstance(kind, types.NoneType):
            value = _one(context, target, builder, part, kind, record.entries[number], value, b, at)
        elif part is True:
            form = _getitem(context, kind, b)
            value = target.get_function(operator.getitem, form)(builder, (value, at))
        values.append(value)
    return _made(target, builder, record, values)
