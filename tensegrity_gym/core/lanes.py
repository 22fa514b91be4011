"""SIMD lanes: an opaque vector type that lets kernels read like scalar physics.

A batch of lattices is stored as structure of arrays with the lanes innermost, ``x[mass, component, lane]``, one 512-bit
vector per number: 8 lanes of float64 or 16 of float32. ``load(x, i, c)`` gives all lanes of one number as a ``Lanes`` value;
``+ - * /``, comparisons, ``sqrt``, ``fma``, ``select`` act lane by lane. The same functions accept arrays without the lane
axis and then work on single numbers: every kernel is its own scalar twin, and gives the same bits, because each operation is
IEEE exact and no lane ever sees its neighbours. A single number is a type of its own too, ``Lanes`` of one, because a plain
float32 would be promoted by every literal, and round elsewhere.

Loads and stores take raw offsets: no bounds are checked, no negative index wraps. Validate one layer up.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model
from numba.np.arrayobj import populate_array

VECTOR_BITS = 512


def lane_count(dtype: Any) -> int:
    """Lanes of one vector of ``dtype``: 8 for float64, 16 for float32."""
    return VECTOR_BITS // (8 * np.dtype(dtype).itemsize)


class LanesType(types.Type):
    """numba type of a vector of floats, one a lane; of ``count`` 1 it is a scalar that meets literals as a vector does."""

    def __init__(self, dtype: types.Float, count: int) -> None:
        self.dtype = dtype
        self.count = count
        super().__init__(name=f"Lanes({dtype} x {self.count})")


class MaskType(types.Type):
    """numba type of a vector of truth values, one a lane."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(name=f"Mask({count})")


def _llvm_float(dtype: types.Float) -> ir.Type:
    return ir.DoubleType() if dtype.bitwidth == 64 else ir.FloatType()


def _llvm_lanes(lanes: LanesType) -> ir.Type:
    element = _llvm_float(lanes.dtype)
    return element if lanes.count == 1 else ir.VectorType(element, lanes.count)


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: LanesType) -> None:
        super().__init__(dmm, fe_type, _llvm_lanes(fe_type))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: MaskType) -> None:
        bit = ir.IntType(1)
        super().__init__(dmm, fe_type, bit if fe_type.count == 1 else ir.VectorType(bit, fe_type.count))


# ---------------------------------------------------------------------------------------------- memory
def _element_type(array: types.Array, scalar_ndim: int) -> LanesType | None:
    """One lane where ``array`` has ``scalar_ndim`` dimensions, a vector of them where it has one more."""
    if not isinstance(array, types.Array) or array.layout != "C" or not isinstance(array.dtype, types.Float):
        return None
    counts = {scalar_ndim: 1, scalar_ndim + 1: VECTOR_BITS // array.dtype.bitwidth}
    return LanesType(array.dtype, counts[array.ndim]) if array.ndim in counts else None


def _pointer(context: Any, builder: Any, array_type: types.Array, array: Any, indices: list[Any], element: LanesType) -> Any:
    """Pointer to the element; the last axis of a lane array is whole vectors."""
    struct = context.make_array(array_type)(context, builder, array)
    offset = indices[0]
    shape = cgutils.unpack_tuple(builder, struct.shape)
    for axis, index in enumerate(indices[1:], start=1):
        offset = builder.add(builder.mul(offset, shape[axis]), index)
    offset = builder.mul(offset, ir.Constant(ir.IntType(64), element.count))
    return builder.bitcast(builder.gep(struct.data, [offset]), _llvm_lanes(element).as_pointer())


def _alignment(element: LanesType) -> int:
    return int(element.dtype.bitwidth) // 8


def _index(context: Any, builder: Any, value: Any, value_type: types.Type) -> Any:
    return context.cast(builder, value, value_type, types.intp)


def _make_load(n_index: int) -> Any:
    def typed(array: types.Array) -> LanesType | None:
        return _element_type(array, n_index)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        indices = [_index(context, builder, a, t) for a, t in zip(args[1:], sig.args[1:], strict=True)]
        pointer = _pointer(context, builder, sig.args[0], args[0], indices, sig.return_type)
        return builder.load(pointer, align=_alignment(sig.return_type))

    return typed, generate


@intrinsic
def load(typingctx: Any, array: Any, i: Any, c: Any) -> Any:
    """``array[i, c]``: one number of an (n, k) array, all lanes of an (n, k, lanes) one."""
    typed, generate = _make_load(2)
    return None if typed(array) is None else (signature(typed(array), array, i, c), generate)


@intrinsic
def load1(typingctx: Any, array: Any, i: Any) -> Any:
    """``array[i]``: one number of an (n,) array, all lanes of an (n, lanes) one."""
    typed, generate = _make_load(1)
    return None if typed(array) is None else (signature(typed(array), array, i), generate)


def _make_store(n_index: int) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        element = _element_type(sig.args[0], n_index)
        indices = [_index(context, builder, a, t) for a, t in zip(args[1:-1], sig.args[1:-1], strict=True)]
        pointer = _pointer(context, builder, sig.args[0], args[0], indices, element)
        builder.store(_to_lanes(context, builder, args[-1], sig.args[-1], element), pointer, align=_alignment(element))
        return context.get_dummy_value()

    return generate


@intrinsic
def store(typingctx: Any, array: Any, i: Any, c: Any, value: Any) -> Any:
    """``array[i, c] = value``, the counterpart of :func:`load`."""
    return signature(types.void, array, i, c, value), _make_store(2)


@intrinsic
def store1(typingctx: Any, array: Any, i: Any, value: Any) -> Any:
    """``array[i] = value``, the counterpart of :func:`load1`."""
    return signature(types.void, array, i, value), _make_store(1)


# ------------------------------------------------------------------------------------------ arithmetic
def _to_lanes(context: Any, builder: Any, value: Any, value_type: types.Type, target: types.Type) -> Any:
    """``value`` as ``target``: scalars are cast and, for lanes, splat."""
    if value_type == target:
        return value
    if not isinstance(target, LanesType):
        return context.cast(builder, value, value_type, target)
    scalar = context.cast(builder, value, value_type, target.dtype)
    if target.count == 1:
        return scalar
    vector = ir.Constant(_llvm_lanes(target), ir.Undefined)
    first = builder.insert_element(vector, scalar, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), target.count), [0] * target.count)
    return builder.shuffle_vector(first, vector, mask)


def _common(*args: Any) -> LanesType | None:
    """The lanes type among ``args`` if all others are it or plain numbers."""
    found = [a for a in args if isinstance(a, LanesType)]
    if not found or any(a != found[0] and not isinstance(a, (types.Number, types.IntegerLiteral)) for a in args):
        return None
    return found[0]


def _register_binary(op: Any, instruction: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            common = _common(*args) if len(args) == 2 else None
            return None if common is None else signature(common, *args)

    infer_global(op)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (_to_lanes(context, builder, a, t, sig.return_type) for a, t in zip(args, sig.args, strict=True))
        return getattr(builder, instruction)(left, right)

    for left, right in ((LanesType, LanesType), (LanesType, types.Number), (types.Number, LanesType)):
        lower_builtin(op, left, right)(lower)


for _op, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv")):
    _register_binary(_op, _name)


@infer_global(operator.neg)
class _Neg(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(args[0], args[0]) if len(args) == 1 and isinstance(args[0], LanesType) else None


@lower_builtin(operator.neg, LanesType)
def _lower_neg(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


def _register_comparison(op: Any, symbol: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            common = _common(*args) if len(args) == 2 else None
            return None if common is None else signature(MaskType(common.count), *args)

    infer_global(op)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        common = _common(*sig.args)
        assert common is not None
        left, right = (_to_lanes(context, builder, a, t, common) for a, t in zip(args, sig.args, strict=True))
        return builder.fcmp_ordered(symbol, left, right)

    for left, right in ((LanesType, LanesType), (LanesType, types.Number), (types.Number, LanesType)):
        lower_builtin(op, left, right)(lower)


for _op, _name in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _register_comparison(_op, _name)


def _register_logic(op: Any, instruction: str) -> None:
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            both = len(args) == 2 and all(isinstance(a, MaskType) for a in args)
            return signature(args[0], *args) if both else None

    infer_global(op)(Template)

    @lower_builtin(op, MaskType, MaskType)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_register_logic(operator.and_, "and_")
_register_logic(operator.or_, "or_")


# ------------------------------------------------------------------------------------------- functions
def _call_llvm(builder: Any, name: str, kind: types.Type, args: list[Any]) -> Any:
    """Call LLVM's intrinsic ``name`` on scalars or vectors of ``kind``."""
    if isinstance(kind, LanesType):
        llvm_type, suffix = _llvm_lanes(kind), f"f{kind.dtype.bitwidth}"
        suffix = suffix if kind.count == 1 else f"v{kind.count}{suffix}"
    else:
        llvm_type, suffix = _llvm_float(kind), f"f{kind.bitwidth}"
    function_type = ir.FunctionType(llvm_type, [llvm_type] * len(args))
    function = cgutils.get_or_insert_function(builder.module, function_type, f"{name}.{suffix}")
    return builder.call(function, args)


@intrinsic
def sqrt(typingctx: Any, x: Any) -> Any:
    """Correctly rounded square root, lane by lane."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call_llvm(builder, "llvm.sqrt", sig.return_type, list(args))

    return signature(x, x), generate


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c`` rounded once. Exact by definition, so the same bits with and without lanes."""
    common = _common(a, b, c)
    target = common or next((t for t in (a, b, c) if isinstance(t, types.Float)), None)
    if target is None:
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [_to_lanes(context, builder, v, t, sig.return_type) for v, t in zip(args, sig.args, strict=True)]
        return _call_llvm(builder, "llvm.fma", sig.return_type, values)

    return signature(target, a, b, c), generate


@intrinsic
def select(typingctx: Any, condition: Any, yes: Any, no: Any) -> Any:
    """``yes`` where ``condition`` holds, else ``no``, lane by lane."""
    target = _common(yes, no) or (yes if isinstance(yes, types.Float) else no)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [_to_lanes(context, builder, v, t, sig.return_type) for v, t in zip(args[1:], sig.args[1:], strict=True)]
        return builder.select(args[0], *values)

    return signature(target, condition, yes, no), generate


@intrinsic
def any_lane(typingctx: Any, condition: Any) -> Any:
    """True if ``condition`` holds in any lane."""
    if not isinstance(condition, MaskType):
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if sig.args[0].count == 1:
            return args[0]
        bits = ir.IntType(sig.args[0].count)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), ir.Constant(bits, 0))

    return signature(types.boolean, condition), generate


@intrinsic
def splat(typingctx: Any, number: Any, like: Any) -> Any:
    """``number`` in every lane, of the type of ``like``."""
    if not isinstance(like, LanesType):
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _to_lanes(context, builder, args[0], sig.args[0], sig.return_type)

    return signature(like, number, like), generate


@intrinsic
def stack_rows(typingctx: Any, rows: Any, like: Any) -> Any:
    """Uninitialised scratch array of ``rows`` (a literal) numbers of the type of ``like``, on the stack of the kernel.

    It lives until the compiled entry point returns; ask once, outside loops.
    """
    if not isinstance(rows, types.IntegerLiteral) or not isinstance(like, LanesType):
        return None
    shape = [rows.literal_value, like.count][: 1 if like.count == 1 else 2]
    dtype = like.dtype
    array_type = types.Array(dtype, len(shape), "C")

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        size = dtype.bitwidth // 8
        data = cgutils.alloca_once(builder, _llvm_lanes(like), size=shape[0])
        array = context.make_array(array_type)(context, builder)
        populate_array(
            array,
            data=builder.bitcast(data, _llvm_float(dtype).as_pointer()),
            shape=[ir.Constant(ir.IntType(64), n) for n in shape],
            strides=[ir.Constant(ir.IntType(64), n) for n in (like.count * size, size)[-len(shape) :]],
            itemsize=ir.Constant(ir.IntType(64), size),
            meminfo=None,
        )
        return array._getvalue()

    return signature(array_type, rows, like), generate


def lanes_empty(shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    """Zeroed array of ``shape + (lanes,)``, aligned so that no vector straddles two cache lines."""
    full = (*shape, lane_count(dtype))
    size = math.prod(full) * np.dtype(dtype).itemsize
    raw = np.zeros(size + 64, dtype=np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(dtype).reshape(full)
