"""Sample a cell of several pieces of surface by lines, to find which pieces bound the same part.

Lines along each axis run through the cell at equal distances, and their crossings form a grid of
points. The items along a line are its ends, points, and crossings with the surface. Two items are
joined if the line between them is inside the body, as the directions of the crossings tell.

The volume and the second moments of a part are integrals along the lines of the axis that crosses
the part's pieces most often: they are exact for a wall normal to that axis. All lengths are in
cells, from the cell's low corner.
"""

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.backend.trees import root
from msmpetsc.geometry.morton import COPIES
from msmpetsc.geometry.valid_cells import clip_to_cell, grown

# lines in a row along each axis of a cell [-]; a part 1/8 of a cell wide meets a line
LINES = 8
# place of the lines in their strips, along x, y and z [-]; unequal, so that no line
# meets the edges of symmetric meshes
PLACE = np.array([0.513, 0.479, 0.527])
# tolerance of a crossing's height in a cell [cells]; rounding
ROUNDING = 1e-9
# kinds of an item along a line, in their order at equal heights: at a slit without
# width, a line leaves the body before it enters again
START, LEAVES, POINT, ENTERS, STOP = range(5)


@njit()
def _join(parent: Indices, a: int, b: int) -> None:
    a, b = root(parent, a), root(parent, b)
    parent[max(a, b)] = min(a, b)


@njit()
def _is_left(p: Floats, q: Floats, y: float, z: float, b: int, c: int) -> bool:
    """Return whether (y, z) is left of the edge from p to q, seen along an axis.

    The edge in the other direction gives the opposite answer, to the last bit.
    """
    turned = p[b] > q[b] or (p[b] == q[b] and p[c] > q[c])
    low, high = (q, p) if turned else (p, q)
    side = (high[b] - low[b]) * (z - low[c]) - (high[c] - low[c]) * (y - low[b])
    return bool((side > 0.0) != turned)


@njit()
def _crossings(triangles: Rows, axis: int, place: Floats) -> Rows:
    """Return the crossings (n, 4) of lines along an axis with triangles, in a cell.

    A row has the number of the line, the height, LEAVES or ENTERS, and the triangle's row.
    """
    b, c = (axis + 1) % 3, (axis + 2) % 3
    crossings = np.empty((16, 4))
    n = 0
    for t in range(len(triangles)):
        p, q, r = triangles[t]
        low_b, high_b = min(p[b], q[b], r[b]), max(p[b], q[b], r[b])
        low_c, high_c = min(p[c], q[c], r[c]), max(p[c], q[c], r[c])
        for i in range(LINES):
            y = (i + place[b]) / LINES
            if y < low_b or y > high_b:
                continue
            for j in range(LINES):
                z = (j + place[c]) / LINES
                if z < low_c or z > high_c:
                    continue
                left = _is_left(p, q, y, z, b, c)
                if left != _is_left(q, r, y, z, b, c) or left != _is_left(r, p, y, z, b, c):
                    continue
                u = (q[b] - y) * (r[c] - z) - (q[c] - z) * (r[b] - y)
                v = (r[b] - y) * (p[c] - z) - (r[c] - z) * (p[b] - y)
                w = (p[b] - y) * (q[c] - z) - (p[c] - z) * (q[b] - y)
                height = (u * p[axis] + v * q[axis] + w * r[axis]) / (u + v + w)
                if -ROUNDING <= height <= 1.0 + ROUNDING:
                    crossings = grown(crossings, n)
                    crossings[n, 0], crossings[n, 1] = i * LINES + j, min(max(height, 0.0), 1.0)
                    crossings[n, 2], crossings[n, 3] = LEAVES if left else ENTERS, t
                    n += 1
    return crossings[:n]


@njit()
def _items(
    triangles: Rows, piece: Indices, axis: int, place: Floats, pieces: int
) -> tuple[Indices, Floats, Indices, Indices]:
    """Return line, height, kind and node of the items along the lines of an axis, in order.

    Nodes below ``pieces`` are pieces, further nodes are points.
    """
    stride = np.array([LINES * LINES, LINES, 1])
    b, c = (axis + 1) % 3, (axis + 2) % 3
    crossing = _crossings(triangles, axis, place)
    count = len(crossing) + LINES**2 * (LINES + 2)
    line, kind = np.empty(count, np.int64), np.empty(count, np.int64)
    height, node = np.empty(count), np.full(count, -1)
    for n in range(len(crossing)):
        line[n], height[n], kind[n] = int(crossing[n, 0]), crossing[n, 1], int(crossing[n, 2])
        node[n] = piece[int(crossing[n, 3])]
    n = len(crossing)
    for i in range(LINES):
        for j in range(LINES):
            line[n : n + LINES + 2] = i * LINES + j
            height[n], kind[n] = 0.0, START
            height[n + 1], kind[n + 1] = 1.0, STOP
            n += 2
            for k in range(LINES):
                height[n], kind[n] = (k + place[axis]) / LINES, POINT
                node[n] = pieces + k * stride[axis] + i * stride[b] + j * stride[c]
                n += 1
    order = np.argsort(2.0 * line + height + ROUNDING * kind)
    return line[order], height[order], kind[order], node[order]


@njit()
def split_cell(
    triangles: Rows, piece: Indices, flush: Array, part: Indices, faces: Array, sums: Rows
) -> int:
    """Find the parts of the body in a cell; return their number.

    triangles : (t, 3, 3) in the cell, from its low corner
    piece     : (t,) piece of each triangle
    flush     : (t,) bits of ``cell_parts._flush``
    part      : (k,) part of each piece, set here; -1 for a flush piece that no line meets
    faces     : (6, LINES^2) part at each line of each face, set here
    sums      : (COPIES, 11) integrals of the corners' functions (8) and second moments (3) over
                each part, set here
    """
    pieces = len(part)
    parent = np.arange(pieces + LINES**3)
    met = np.zeros((pieces, 3), np.int64)
    for axis in range(3):
        _, _, kind, node = _items(triangles, piece, axis, PLACE, pieces)
        for n in range(len(kind)):
            if kind[n] == LEAVES or kind[n] == ENTERS:
                met[node[n], axis] += 1
            if kind[n] != START and node[n] >= 0 and node[n - 1] >= 0 and _is_inside(kind, n):
                _join(parent, node[n - 1], node[n])
    _join_unseen(triangles, piece, flush, met, parent)
    number = np.full(len(parent), -1)
    count = 0
    for t in range(len(triangles)):
        tree = root(parent, piece[t])
        if number[tree] < 0 and (flush[t] == 0 or met[piece[t]].sum() > 0):
            number[tree] = min(count, COPIES - 1)
            count = min(count + 1, COPIES)
    for k in range(pieces):
        part[k] = number[root(parent, k)]
    if count < 2:
        return 1
    crossed = np.zeros((count, 3), np.int64)
    for k in range(pieces):
        if part[k] >= 0:
            crossed[part[k]] += met[k]
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        line, height, kind, node = _items(triangles, piece, axis, PLACE, pieces)
        for n in range(len(line)):
            if kind[n] == START or not _is_inside(kind, n):
                continue
            # a line without any crossing has points
            p = number[root(parent, max(node[n - 1], node[n]))]
            if p < 0:
                continue
            if kind[n - 1] == START:
                faces[axis, line[n]] = p
            if kind[n] == STOP:
                faces[3 + axis, line[n]] = p
            if crossed[p].argmax() == axis:
                _add(sums[p], line[n], height[n - 1], height[n], (axis, b, c))
    return count


@njit()
def _join_unseen(
    triangles: Rows, piece: Indices, flush: Array, met: Indices, parent: Indices
) -> None:
    """Join the pieces that no line meets with the parts that they bound.

    A ray inwards from the piece may meet another piece of the part. If not, a grid point near the
    middle of the ray is in the part if no surface lies between. Otherwise the piece is a tip.
    """
    pieces = len(met)
    for t in range(len(triangles)):
        k = piece[t]
        if flush[t] > 0 or met[k].sum() > 0:
            continue
        start, inwards, length = _ray_inwards(triangles, t)
        other, length = _first_met(triangles, start, inwards, length, t)
        if other >= 0:
            _join(parent, k, piece[other])
        elif length > ROUNDING:
            seen = _seen_point(triangles, start + 0.5 * length * inwards)
            if seen >= 0:
                _join(parent, k, pieces + seen)


@njit()
def _seen_point(triangles: Rows, start: Floats) -> int:
    """Return the number of a grid point around ``start`` (3,) that no triangle hides, or -1."""
    for v in range(8):
        number, way = 0, np.empty(3)
        for axis in range(3):
            k = int(np.floor(start[axis] * LINES - PLACE[axis])) + (v >> axis & 1)
            k = min(max(k, 0), LINES - 1)
            number = LINES * number + k
            way[axis] = (k + PLACE[axis]) / LINES - start[axis]
        if _first_met(triangles, start, way, 1.0, -1)[0] < 0:
            return number
    return -1


@njit()
def _ray_inwards(triangles: Rows, t: int) -> tuple[Floats, Floats, float]:
    """Return start (3,), direction (3,) and length in the cell of a ray inwards from triangle t.

    The ray begins at the middle of the part of the triangle in the cell. Its length is 0 if the
    triangle is not in the cell, or has no area.
    """
    part = clip_to_cell(triangles[t], np.zeros(3, np.int64), np.empty((3, 12, 3)))
    start = np.zeros(3)
    for point in part:
        start += point / len(part)
    inwards = -np.cross(triangles[t, 1] - triangles[t, 0], triangles[t, 2] - triangles[t, 0])
    area = np.sqrt((inwards * inwards).sum())
    if len(part) == 0 or area == 0.0:
        return start, inwards, 0.0
    inwards /= area
    length = np.inf
    for axis in range(3):
        if inwards[axis] != 0.0:
            wall = 1.0 if inwards[axis] > 0 else 0.0
            length = min(length, (wall - start[axis]) / inwards[axis])
    return start, inwards, length


@njit()
def _first_met(
    triangles: Rows, start: Floats, way: Floats, length: float, left_out: int
) -> tuple[int, float]:
    """Return the first triangle through which a ray leaves the body, and the crossing's height.

    If there is none, the result is -1 and ``length``. Source: Moeller and Trumbore 1997.

    start, way : (3,) start of the ray inside the body, and direction of the ray
    length     : greatest height, in lengths of ``way``
    left_out   : triangle that does not count
    """
    met = -1
    for n in range(len(triangles)):
        e, f = triangles[n, 1] - triangles[n, 0], triangles[n, 2] - triangles[n, 0]
        across = np.cross(way, f)
        volume = (e * across).sum()
        # the ray may only leave the body
        if n == left_out or volume >= 0.0:
            continue
        offset = start - triangles[n, 0]
        u, turned = (offset * across).sum() / volume, np.cross(offset, e)
        v, height = (way * turned).sum() / volume, (f * turned).sum() / volume
        if 0.0 < height < length and u >= 0.0 and v >= 0.0 and u + v <= 1.0:
            met, length = n, height
    return met, length


@njit()
def _is_inside(kind: Indices, n: int) -> bool:
    """Return whether the line between items n - 1 and n may be inside the body.

    If neither item is a crossing, the line is inside if its points are.
    """
    return bool(kind[n - 1] != LEAVES and kind[n] != ENTERS)


@njit()
def _add(sums: Floats, line: int, low: float, high: float, axes: tuple[int, int, int]) -> None:
    """Add the integrals along a line of a cell from height ``low`` to ``high``."""
    axis, b, c = axes
    across = (line // LINES + PLACE[b]) / LINES, (line % LINES + PLACE[c]) / LINES
    weight = 1.0 / LINES**2
    upper = 0.5 * (high * high - low * low)
    along = (high - low - upper, upper)
    for v in range(8):
        bits = (v >> 2 & 1, v >> 1 & 1, v & 1)
        y = across[0] if bits[b] else 1.0 - across[0]
        z = across[1] if bits[c] else 1.0 - across[1]
        sums[v] += weight * y * z * along[bits[axis]]
    sums[8 + b] += weight * (high - low) * (across[0] - 0.5) ** 2
    sums[8 + c] += weight * (high - low) * (across[1] - 0.5) ** 2
    sums[8 + axis] += weight * ((high - 0.5) ** 3 - (low - 0.5) ** 3) / 3.0
