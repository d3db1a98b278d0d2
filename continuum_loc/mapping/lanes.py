"""
Sixteen points side by side in single precision, which a processor compares at once.

A group is sixteen rows of a sorted cloud that lie close together: its row of `lanes`, (G, 3, 16),
holds their x, y and z from an origin [m], coordinate by coordinate; its row of `faces` their
normals. The compiled functions here look at all points of a group; a set of its points is the bits
of an integer.
Single precision only sorts out what cannot matter (`slack2` says by how much it may err); what is
left is settled in double precision by the caller.

The vectors are written out because numba's compiler unrolls a loop over sixteen before it would
vectorise it. LLVM splits them to whatever width the processor has.
"""

from __future__ import annotations

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
import numpy as np

LANES = 16
ALL_LANES = (1 << LANES) - 1
CACHE_LINE = 64  # bytes
FAR = np.float32(
    1e15
)  # m; where a group that is not full has its spare points, facing nowhere (nan)
SINGLE = 2.0**-24  # relative rounding of single precision
COS_ERROR = 1e-6  # bound on the rounding of a cosine of two unit vectors in single precision

_FLOAT, _INT, _SHORT = ir.FloatType(), ir.IntType(64), ir.IntType(32)
_VECTOR, _BITS = ir.VectorType(_FLOAT, LANES), ir.IntType(LANES)
_FUSE = ('contract',)  # a product and a sum may be rounded once
_NUMBERS, _ONE = ir.VectorType(_SHORT, LANES), ir.Constant(_INT, 1)
_LEAST = 'llvm.vector.reduce.fmin.v16f32'
single, integer = types.float32, types.int64
_FOUND = types.Tuple((integer, single, single))


def pack_lanes(rows: np.ndarray, spare: float) -> np.ndarray:
    """Lanes (G, 3, 16) of rows (P, 3); the last group is filled up with `spare`."""
    groups = -(-len(rows) // LANES)
    filled = np.full((groups * LANES, 3), spare, np.float32)
    filled[: len(rows)] = rows
    lanes = empty_lanes(groups)
    lanes[:] = filled.reshape(groups, LANES, 3).transpose(0, 2, 1)
    return lanes


def empty_lanes(groups: int) -> np.ndarray:
    """Memory for lanes (groups, 3, 16) that begins with a cache line, as each vector then does."""
    size, spare = groups * 3 * LANES, CACHE_LINE // 4
    memory = np.empty(size + spare, np.float32)
    first = -memory.ctypes.data % CACHE_LINE // 4
    after = first + size
    return memory[first:after].reshape(groups, 3, LANES)


@njit(cache=True, inline='always')
def slack2(distance2, rounding):
    """
    Bound on the error of a squared distance [m^2] in single precision, near that distance.

    rounding: bound [m] on the error of a difference of two coordinates, 4 `SINGLE` times the
    largest one.
    """
    return 4.0 * rounding * (np.sqrt(distance2) + 4.0 * rounding) + 32.0 * SINGLE * distance2


# ------------------------------------------------------------ vectors


def _splat(builder, value):
    """All lanes the same."""
    undefined = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(_SHORT, 0))
    zeros = ir.Constant(ir.VectorType(_SHORT, LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, zeros)


def _data(context, builder, signature, args, which):
    """Return where the data of an array begins, of those in `args`."""
    return make_array(signature.args[which])(context, builder, args[which]).data


def _vectors(builder, data, group):
    """Return the three vectors of a group."""
    start = builder.mul(group, ir.Constant(_INT, 3 * LANES))
    places = (builder.add(start, ir.Constant(_INT, row * LANES)) for row in range(3))
    pointers = (builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer()) for at in places)
    return [builder.load(pointer, align=4) for pointer in pointers]


def _dot(builder, left, right):
    """Sum of the products of three vectors each."""
    total = None
    for a, b in zip(left, right, strict=True):
        product = builder.fmul(a, b, flags=_FUSE)
        total = product if total is None else builder.fadd(total, product, flags=_FUSE)
    return total


def _from(builder, points, place):
    """Points (three vectors) as seen from a place (three numbers)."""
    return [
        builder.fsub(row, _splat(builder, value)) for row, value in zip(points, place, strict=True)
    ]


def _mask(builder, comparison, left, right):
    """Bits of the lanes where the comparison holds."""
    holds = builder.fcmp_ordered(comparison, left, right)
    return builder.zext(builder.bitcast(holds, _BITS), _INT)


def _call(builder, name, result, *args, fastmath=('nnan', 'nsz')):
    """Call one of LLVM's own functions."""
    declared = builder.module.globals.get(name) or ir.Function(
        builder.module, ir.FunctionType(result, [arg.type for arg in args]), name
    )
    return builder.call(declared, args, fastmath=fastmath)


# ------------------------------------------------------------ what kernels call


@intrinsic
def near_lanes(_, lanes, group, x, y, z, limit2):
    """Bits of a group's points that are no farther from a place than sqrt(limit2)."""

    def generate(context, builder, signature, args):
        points = _vectors(builder, _data(context, builder, signature, args, 0), args[1])
        seen = _from(builder, points, args[2:5])
        return _mask(builder, '<=', _dot(builder, seen, seen), _splat(builder, args[5]))

    return integer(lanes, integer, single, single, single, single), generate


@intrinsic
def facing_lanes(_, faces, group, dx, dy, dz, min_cos):
    """Bits of a group's points whose normal n has -(n . d) >= min_cos for the direction d."""

    def generate(context, builder, signature, args):
        normals = _vectors(builder, _data(context, builder, signature, args, 0), args[1])
        direction = [_splat(builder, value) for value in args[2:5]]
        along = _dot(builder, normals, direction)
        return _mask(builder, '<=', along, _splat(builder, builder.fneg(args[5])))

    return integer(faces, integer, single, single, single, single), generate


@intrinsic
def two_nearest(_, lanes, groups, first, after, x, y, z):
    """
    Find the nearest point to a place in groups[first:after], and how near the next one is.

    groups: None where groups first..after themselves are meant. Returns the point's number, 16
    times its group's and its lane, and the squared distances [m^2] of both; inf where there is
    none.
    """

    def generate(context, builder, signature, args):
        return _two_nearest(context, builder, signature, args, lambda group: None)

    return _FOUND(lanes, groups, integer, integer, single, single, single), generate


@intrinsic
def two_nearest_facing(_, lanes, groups, first, after, x, y, z, faces, dx, dy, dz, min_cos):
    """Find what `two_nearest` finds, of the points that `facing_lanes` would choose."""

    def generate(context, builder, signature, args):
        data = _data(context, builder, signature, args, 7)
        direction = [_splat(builder, value) for value in args[8:11]]
        limit = _splat(builder, builder.fneg(args[11]))

        def faces_beam(group):
            along = _dot(builder, _vectors(builder, data, group), direction)
            return builder.fcmp_ordered('<=', along, limit)

        return _two_nearest(context, builder, signature, args, faces_beam)

    place = single, single, single
    return _FOUND(lanes, groups, integer, integer, *place, faces, *place, single), generate


def _two_nearest(context, builder, signature, args, counts):
    """Each lane keeps its own two nearest; only at the end are lanes compared, which is slow."""
    far = _splat(builder, ir.Constant(_FLOAT, float('inf')))
    least, second = (cgutils.alloca_once_value(builder, far) for _ in range(2))
    holder = cgutils.alloca_once_value(builder, ir.Constant(_NUMBERS, [0] * LANES))
    lanes, named = _data(context, builder, signature, args, 0), signature.args[1] != types.none
    listed = _data(context, builder, signature, args, 1) if named else None
    with cgutils.for_range_slice(builder, args[2], args[3], _ONE, _INT) as (at, _):
        group = builder.load(builder.gep(listed, [at])) if named else builder.trunc(at, _SHORT)
        row = builder.sext(group, _INT)
        seen = _from(builder, _vectors(builder, lanes, row), args[4:7])
        found, counted = _dot(builder, seen, seen), counts(row)
        if counted is not None:
            found = builder.select(counted, found, far)
        before = builder.load(least)
        nearer = builder.fcmp_ordered('<', found, before)
        builder.store(builder.select(nearer, found, before), least)
        builder.store(builder.select(nearer, _splat(builder, group), builder.load(holder)), holder)
        passed = builder.select(nearer, before, found)
        builder.store(_smaller(builder, passed, builder.load(second)), second)
    return _compare_lanes(context, builder, signature, *map(builder.load, (least, second, holder)))


def _compare_lanes(context, builder, signature, least, second, holder):
    """Return the number of the nearest point, its squared distance, and that of the next."""
    best = _call(builder, _LEAST, _FLOAT, least)
    winners = builder.fcmp_ordered('==', least, _splat(builder, best))
    lane = builder.cttz(builder.bitcast(winners, _BITS), ir.Constant(ir.IntType(1), 0))
    lane = builder.zext(lane, _SHORT)
    numbers = ir.Constant(_NUMBERS, list(range(LANES)))
    chosen = builder.icmp_signed('==', numbers, _splat(builder, lane))
    others = builder.select(chosen, second, _smaller(builder, least, second))
    next_best = _call(builder, _LEAST, _FLOAT, others)
    group = builder.sext(builder.extract_element(holder, lane), _INT)
    point = builder.add(builder.mul(group, ir.Constant(_INT, LANES)), builder.zext(lane, _INT))
    return context.make_tuple(builder, signature.return_type, (point, best, next_best))


def _smaller(builder, a, b):
    return builder.select(builder.fcmp_ordered('<', a, b), a, b)


@intrinsic
def nearest_lane2(_, lanes, group, chosen, x, y, z):
    """Squared distance [m^2] from a place to a group's nearest chosen point; inf if none."""

    def generate(context, builder, signature, args):
        points = _vectors(builder, _data(context, builder, signature, args, 0), args[1])
        seen = _from(builder, points, args[3:6])
        chosen = builder.bitcast(
            builder.trunc(args[2], _BITS), ir.VectorType(ir.IntType(1), LANES)
        )
        far = _splat(builder, ir.Constant(_FLOAT, float('inf')))
        distance2 = builder.select(chosen, _dot(builder, seen, seen), far)
        return _call(builder, _LEAST, _FLOAT, distance2)

    return single(lanes, integer, integer, single, single, single), generate


@intrinsic
def rival_lanes(_, lanes, group, x, y, z, ox, oy, oz, edge, limit2):
    """
    Bits of a group's points p that may be nearer than the point o somewhere in a cube.

    The cube has the centre c = (x, y, z) and this edge [m]; they may be where
    |p - c|^2 - edge |p - o|_1 <= limit2, with limit2 = |o - c|^2.
    """

    def generate(context, builder, signature, args):
        points = _vectors(builder, _data(context, builder, signature, args, 0), args[1])
        seen = _from(builder, points, args[2:5])
        apart = _from(builder, points, args[5:8])
        swing = None
        for part in apart:
            size = _call(builder, 'llvm.fabs.v16f32', _VECTOR, part)
            swing = size if swing is None else builder.fadd(swing, size)
        swing = builder.fmul(swing, _splat(builder, args[8]))
        gain = builder.fsub(_dot(builder, seen, seen), swing)
        return _mask(builder, '<=', gain, _splat(builder, args[9]))

    return integer(lanes, integer, *[single] * 8), generate


@intrinsic
def lowest_lane(_, chosen):
    """Return the number of the first chosen point, of at least one."""

    def generate(context, builder, signature, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return integer(integer), generate


@intrinsic
def fetch(_, array, at):
    """Ask for the element `at` of a C-ordered array ahead of its use: memory is slow."""

    def generate(context, builder, signature, args):
        place = builder.gep(_data(context, builder, signature, args, 0), [args[1]])
        place = builder.bitcast(place, ir.IntType(8).as_pointer())
        read, second_level, data_cache = (ir.Constant(_SHORT, value) for value in (0, 2, 1))
        flags = read, second_level, data_cache
        _call(builder, 'llvm.prefetch.p0', ir.VoidType(), place, *flags, fastmath=())
        return context.get_dummy_value()

    return types.none(array, integer), generate
