"""Sums over the windows of the Lucas-Kanade tracker in vector registers: one lane for each column of the window.

The compiler does not reorder the additions of a loop, since that changes rounding, so it adds one number after the
other. Here sixteen columns are added at once, in an order that is always the same (see `shift_products` for why this is
written in LLVM's terms).
"""

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

SIZE = 15
"""Side of a window, pixels: a layout of the compiled code (Lucas and Kanade 1981)."""
WIDE = SIZE + 2
"""Side of a template: the window and the pixels around it, for its gradients."""
LANES = 16
"""Columns that are added at once: those of a window and one that is not used."""

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, LANES)


class _Lanes:
    """Writes vector code into the function that numba compiles."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.builder = builder
        self.data = [
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        ]
        self.number = context.get_constant(types.intp, 0).type

    def rows(self) -> Any:
        """A loop over the rows of a window."""
        return cgutils.for_range(self.builder, ir.Constant(self.number, SIZE))

    def place(self, array: int, at: Any) -> Any:
        """The address of a vector in an array (its number among the arguments)."""
        return self.builder.bitcast(self.builder.gep(self.data[array], [at]), _VECTOR.as_pointer())

    def load(self, array: int, row: Any, width: int, offset: int) -> Any:
        """The vector at an offset from the beginning of a row, in an array of so many columns."""
        at = self.builder.add(self.builder.mul(row, ir.Constant(self.number, width)), ir.Constant(self.number, offset))
        return self.builder.load(self.place(array, at), align=4)

    def store(self, value: Any, array: int, row: Any, offset: int) -> None:
        """Put a vector into an array of LANES columns."""
        at = self.builder.add(self.builder.mul(row, ir.Constant(self.number, LANES)), ir.Constant(self.number, offset))
        self.builder.store(value, self.place(array, at), align=4)

    def totals(self, count: int) -> list[Any]:
        """So many vectors of zeros that stay in registers."""
        return [cgutils.alloca_once_value(self.builder, ir.Constant(_VECTOR, None)) for _ in range(count)]

    def add(self, totals: list[Any], values: Sequence[Any]) -> None:
        """Add a vector to each of the totals."""
        for total, value in zip(totals, values, strict=True):
            self.builder.store(self.builder.fadd(self.builder.load(total), value), total)

    def write(self, totals: list[Any], array: int) -> None:
        """Put the totals into the lines of an array of LANES columns."""
        for line, total in enumerate(totals):
            self.store(self.builder.load(total), array, ir.Constant(self.number, line), 0)

    def times(self, a: Any, b: Any) -> Any:
        """Product of two vectors."""
        return self.builder.fmul(a, b)

    def everywhere(self, value: Any) -> Any:
        """A vector of one value."""
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = self.builder.insert_element(undefined, value, ir.Constant(_INT, 0))
        return self.builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES))


@intrinsic
def add_gradients(typing, wide, gradient, sums):  # type: ignore[no-untyped-def]
    """Gradients (2, SIZE, LANES) of a template (WIDE, WIDE), all float32, and sums over its columns, (5, LANES).

    The sums are those of gx gx, gx gy, gy gy, gx, gy; the last lane of the gradients is 0.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature, arguments)
        totals = lanes.totals(5)
        half = ir.Constant(_VECTOR, [0.5] * SIZE + [0.0] * (LANES - SIZE))
        with lanes.rows() as row:
            right, left = (lanes.load(0, row.index, WIDE, WIDE + k) for k in (2, 0))
            low, high = (lanes.load(0, row.index, WIDE, WIDE * k + 1) for k in (2, 0))
            x, y = lanes.times(half, builder.fsub(right, left)), lanes.times(half, builder.fsub(low, high))
            lanes.store(x, 1, row.index, 0)
            lanes.store(y, 1, row.index, SIZE * LANES)
            lanes.add(totals, (lanes.times(x, x), lanes.times(x, y), lanes.times(y, y), x, y))
        lanes.write(totals, 2)
        return context.get_dummy_value()

    return types.void(wide, gradient, sums), generate


@intrinsic
def add_residuals(typing, under, wide, gradient, part_u, part_v, sums):  # type: ignore[no-untyped-def]
    """What a template differs from a picture by, e: sums of gx e, gy e, e, e e over its columns, (5, LANES).

    Args:
        under: float32 (SIZE + 1, LANES + 1), the picture from the pixel before the window's place on.
        wide, gradient: of the template, see `add_gradients`. part_u, part_v: float32, part of a pixel to the place.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature, arguments)
        totals = lanes.totals(4)
        u, v = lanes.everywhere(arguments[3]), lanes.everywhere(arguments[4])
        with lanes.rows() as row:
            rows = []
            for k in range(2):
                left, right = (lanes.load(0, row.index, LANES + 1, (LANES + 1) * k + q) for q in range(2))
                rows.append(builder.fadd(left, lanes.times(u, builder.fsub(right, left))))
            seen = builder.fadd(rows[0], lanes.times(v, builder.fsub(rows[1], rows[0])))
            error = builder.fsub(seen, lanes.load(1, row.index, WIDE, WIDE + 1))
            x, y = lanes.load(2, row.index, LANES, 0), lanes.load(2, row.index, LANES, SIZE * LANES)
            lanes.add(totals, (lanes.times(x, error), lanes.times(y, error), error, lanes.times(error, error)))
        lanes.write(totals, 5)
        return context.get_dummy_value()

    return types.void(under, wide, gradient, part_u, part_v, sums), generate
