"""Sums of products of two fields at many shifts, the inner part of a correlation, in vector registers.

A loop that numba compiles keeps its sums in memory, since it cannot know that arrays do not overlap, and takes four
times as long (measured; a Fourier transform for each window takes two to five times as long). So this part is written
in LLVM's own terms: a block of four rows by up to four vectors of shifts stays in registers while the template passes.
The order of the sums is fixed, so that the result is the same on each run.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from orthoswarm.compute import processor
from orthoswarm.compute.jit import in_place_kernel

LANES = 8  # shifts of one vector: 32 bytes, which all x86 processors with AVX add at once; others take them in parts
ROWS = 4  # rows of shifts of one block: with three vectors each they fill the sixteen registers of AVX2

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_FUSES = processor.fuses()


def _block(vectors: int) -> Any:
    """A function for compiled code that adds the products of one block of ROWS x (LANES vectors) shifts.

    Arguments (arrays are float32 and contiguous; places are indices into their memory):
        window, its place and step: first line below the first row of shifts, and values from line to line.
        template, its place and step: first line; ROWS - 1 lines of zeros precede and follow it.
        lines: of the template, with the zeros that follow. count: its columns.
        score, its place and step: where the sums are added.
    """

    @intrinsic
    def block(typing, window, window_at, window_step, template, template_at, template_step, lines, count, score, score_at, score_step):  # type: ignore[no-untyped-def]  # fmt: skip # noqa: E501
        number = types.intp
        signature = types.void(
            window, number, number, template, number, number, number, number, score, number, number
        )  # fmt: skip
        return signature, _generate

    def _generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        window_at, window_step, template_at, template_step = (arguments[k] for k in (1, 2, 4, 5))
        lines, count, score_at, score_step = (arguments[k] for k in (6, 7, 9, 10))
        window, template, score = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 3, 8)
        )
        sums = [
            [cgutils.alloca_once_value(builder, ir.Constant(_VECTOR, None)) for _ in range(vectors)]
            for _ in range(ROWS)
        ]

        def number(value: int) -> Any:
            return ir.Constant(count.type, value)

        def vector_at(base: Any, at: Any) -> Any:
            return builder.bitcast(builder.gep(base, [at]), _VECTOR.as_pointer())

        with cgutils.for_range(builder, lines) as line:
            seen = builder.gep(window, [builder.add(window_at, builder.mul(line.index, window_step))])
            own = builder.gep(template, [builder.add(template_at, builder.mul(line.index, template_step))])
            with cgutils.for_range(builder, count) as column:
                values = [
                    builder.load(vector_at(seen, builder.add(column.index, number(LANES * k))), align=4)
                    for k in range(vectors)
                ]
                for row in range(ROWS):
                    at = builder.sub(column.index, builder.mul(number(row), template_step))
                    factor = everywhere(builder, builder.load(builder.gep(own, [at])), LANES)
                    for value, total in zip(values, sums[row], strict=True):
                        builder.store(_product_and_sum(builder, factor, value, builder.load(total)), total)
        for row in range(ROWS):
            for k, total in enumerate(sums[row]):
                at = builder.add(score_at, builder.add(builder.mul(number(row), score_step), number(LANES * k)))
                place = vector_at(score, at)
                builder.store(builder.fadd(builder.load(place, align=4), builder.load(total)), place, align=4)
        return context.get_dummy_value()

    return block


def _product_and_sum(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """The sum a b + c, rounded once on machines that do that in one instruction.

    Left to the compiler (the flag "contract") it would depend on what is compiled around it, see `jit.kernel`.
    """
    if not _FUSES:
        return builder.fadd(builder.fmul(a, b), c)
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f32"), [a, b, c])


def everywhere(builder: Any, value: Any, lanes: int) -> Any:
    """A vector of one value in so many lanes."""
    number = ir.IntType(32)
    undefined = ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(number, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(number, lanes), [0] * lanes))


_one, _two, _three, _four = _block(1), _block(2), _block(3), _block(4)


@in_place_kernel
def padded(count, step):  # type: ignore[no-untyped-def]
    """The next multiple of a step."""
    return -(-count // step) * step


@in_place_kernel
def _add_block(vectors, window, seen, template, own, score, out):  # type: ignore[no-untyped-def]
    """Add one block of so many vectors: from a place in the window and in the template to one in the score."""
    n, lines, step, columns = template.shape[2], template.shape[1] - ROWS + 1, window.shape[2], score.shape[1]
    if vectors == 1:
        _one(window, seen, step, template, own, n, lines, n, score, out, columns)
    elif vectors == 2:
        _two(window, seen, step, template, own, n, lines, n, score, out, columns)
    elif vectors == 3:
        _three(window, seen, step, template, own, n, lines, n, score, out, columns)
    else:
        _four(window, seen, step, template, own, n, lines, n, score, out, columns)


@in_place_kernel
def add_products(template, window, score):  # type: ignore[no-untyped-def]
    """Add to `score` the products of a template and a window at each shift, over all their channels.

    Args:
        template: float32 (channels, n + 2 (ROWS - 1), n), with ROWS - 1 lines of zeros before and after.
        window: float32 (channels, rows + n + ROWS - 1, columns + n) at least, zeros beyond what is known.
        score: float32 (rows, columns), multiples of ROWS and of LANES; [i, j] is the sum for the template's first
            pixel at [i, j] of the window.
    """
    channels, lines, n = template.shape
    rows, columns = score.shape
    for channel in range(channels):
        own = (channel * lines + ROWS - 1) * n
        for i in range(0, rows, ROWS):
            seen, j = (channel * window.shape[1] + i) * window.shape[2], 0
            while j < columns:
                left = (columns - j) // LANES
                vectors = 3 if left == 5 else min(left, 4)
                _add_block(vectors, window, seen + j, template, own, score, i * columns + j)
                j += vectors * LANES


@in_place_kernel
def add_wanted_products(template, window, score, wanted):  # type: ignore[no-untyped-def]
    """`add_products` for the wanted blocks of ROWS x LANES shifts alone: bool (rows / ROWS, columns / LANES)."""
    channels, lines, n = template.shape
    rows, columns = score.shape
    blocks = columns // LANES
    for channel in range(channels):
        own = (channel * lines + ROWS - 1) * n
        for i in range(0, rows, ROWS):
            row, seen, k = wanted[i // ROWS], (channel * window.shape[1] + i) * window.shape[2], 0
            while k < blocks:
                if not row[k]:
                    k += 1
                    continue
                vectors = 1
                while vectors < 3 and k + vectors < blocks and row[k + vectors]:
                    vectors += 1
                _add_block(vectors, window, seen + k * LANES, template, own, score, i * columns + k * LANES)
                k += vectors
