/* The inner loops of `kinematics` and `reduction`, compiled: the same sums over many samples at once.

   Arrays are of doubles and components first, as in those modules: samples are contiguous. */

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* One build serves every processor: where it has AVX2, that is used. */
#if defined(__x86_64__) && defined(__ELF__) && defined(__GLIBC__) && (defined(__clang__) || __GNUC__ >= 12)
#define WIDEST __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define WIDEST
#endif

typedef Py_ssize_t Size;
/* As wide as the widest registers; narrower ones take two or four for it. */
typedef double Lanes __attribute__((vector_size(32)));
enum { LANES = 4, SAMPLES = 64, ROWS = 128 };

/* ---- kinematics ---- */

/* Columns x, y, z, p of frames at a stride, one after the other along a chain. */
WIDEST static void carry(Size links, Size m, const double *link, const char *prismatic, const double *values,
                         const double *cosine, const double *sine, double *frames, Size body, Size row)
{
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        for (Size j = 0; j < links; j++) {
            double l[12];
            memcpy(l, link + 16 * j, sizeof l);
            const double *restrict q = values + j * m + start;
            const double *restrict c = cosine + j * m + start, *restrict s = sine + j * m + start;
            for (Size i = 0; i < 3; i++) {
                const double *from = frames + j * body + i * row + start;
                const double *restrict x = from, *restrict y = from + 3 * row, *restrict z = from + 6 * row,
                                       *restrict p = from + 9 * row;
                double *to = frames + (j + 1) * body + i * row + start;
                double *restrict x1 = to, *restrict y1 = to + 3 * row, *restrict z1 = to + 6 * row,
                                 *restrict p1 = to + 9 * row;
                if (j == links - 1)
#pragma GCC ivdep
                    for (Size t = 0; t < n; t++) {
                        x1[t] = l[0] * x[t] + l[4] * y[t] + l[8] * z[t];
                        y1[t] = l[1] * x[t] + l[5] * y[t] + l[9] * z[t];
                        z1[t] = l[2] * x[t] + l[6] * y[t] + l[10] * z[t];
                        p1[t] = l[3] * x[t] + l[7] * y[t] + l[11] * z[t] + p[t];
                    }
                else if (prismatic[j])
#pragma GCC ivdep
                    for (Size t = 0; t < n; t++) {
                        const double along = l[2] * x[t] + l[6] * y[t] + l[10] * z[t];
                        x1[t] = l[0] * x[t] + l[4] * y[t] + l[8] * z[t];
                        y1[t] = l[1] * x[t] + l[5] * y[t] + l[9] * z[t];
                        z1[t] = along;
                        p1[t] = l[3] * x[t] + l[7] * y[t] + l[11] * z[t] + p[t] + q[t] * along;
                    }
                else
#pragma GCC ivdep
                    for (Size t = 0; t < n; t++) {
                        const double u = l[0] * x[t] + l[4] * y[t] + l[8] * z[t];
                        const double v = l[1] * x[t] + l[5] * y[t] + l[9] * z[t];
                        z1[t] = l[2] * x[t] + l[6] * y[t] + l[10] * z[t];
                        p1[t] = l[3] * x[t] + l[7] * y[t] + l[11] * z[t] + p[t];
                        x1[t] = c[t] * u + s[t] * v;
                        y1[t] = c[t] * v - s[t] * u;
                    }
            }
        }
    }
}

/* out = a vector given in a body's axes, along the measuring frame's; axes at a stride. */
static inline __attribute__((always_inline)) void turned(double *restrict out, const double *axes, Size row,
                                                         const double *vector, Size n)
{
    Size given[3] = {0}, count = 0;
    for (Size a = 0; a < 3; a++)
        if (vector[a] != 0)
            given[count++] = a;
    const double *restrict x = axes + 3 * row * given[0], *restrict y = axes + 3 * row * given[1],
                           *restrict z = axes + 3 * row * given[2];
    if (count == 0)
        memset(out, 0, n * sizeof(double));
    else if (count == 1 && vector[given[0]] == 1)
        memcpy(out, x, n * sizeof(double));
    else if (count == 1) {
        const double f = vector[given[0]];
#pragma GCC ivdep
        for (Size t = 0; t < n; t++)
            out[t] = f * x[t];
    } else if (count == 2) {
        const double f = vector[given[0]], g = vector[given[1]];
#pragma GCC ivdep
        for (Size t = 0; t < n; t++)
            out[t] = f * x[t] + g * y[t];
    } else {
        const double f = vector[0], g = vector[1], h = vector[2];
#pragma GCC ivdep
        for (Size t = 0; t < n; t++)
            out[t] = f * x[t] + g * y[t] + h * z[t];
    }
}

WIDEST static void velocities(Size p, Size m, const double *frames, Size body, Size row, const double *point,
                              Size point_row, const Size *at, const double *twist, double *out, Size out_twist,
                              Size out_row)
{
    double lever[3][SAMPLES];
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        Size known = -1;
        for (Size k = 0; k < p; k++) {
            const double *axes = frames + at[k] * body + start, *w = twist + 6 * k + 3;
            double *to = out + k * out_twist + start;
            const int turns = w[0] != 0 || w[1] != 0 || w[2] != 0;
            for (Size i = 0; i < 3; i++)
                turned(to + (3 + i) * out_row, axes + i * row, row, w, n);
            for (Size i = 0; i < 3; i++)
                turned(to + i * out_row, axes + i * row, row, w - 3, n);
            if (!turns)
                continue;
            if (known != at[k]) {
                known = at[k];
                for (Size i = 0; i < 3; i++)
                    for (Size t = 0; t < n; t++)
                        lever[i][t] = point[i * point_row + start + t] - axes[(9 + i) * row + t];
            }
            for (Size i = 0; i < 3; i++) {
                const Size y = (i + 1) % 3, z = (i + 2) % 3;
                const double *restrict wy = to + (3 + y) * out_row, *restrict wz = to + (3 + z) * out_row;
                double *restrict v = to + i * out_row;
#pragma GCC ivdep
                for (Size t = 0; t < n; t++)
                    v[t] += wy[t] * lever[z][t] - wz[t] * lever[y][t];
            }
        }
    }
}

/* Vectors of c components mixed by a matrix (k, c) that every sample has its own of. */
WIDEST static void mix(Size p, Size k, Size c, Size m, const double *vectors, Size vector, Size component,
                       const double *matrices, Size row, Size column, double *out, Size out_vector, Size out_row)
{
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        for (Size j = 0; j < p; j++)
            for (Size i = 0; i < k; i++) {
                const double *f = matrices + i * row + start, *v = vectors + j * vector + start;
                double *to = out + j * out_vector + i * out_row + start;
                Size l = 3;
                if (c < 3)
                    memset(to, 0, n * sizeof(double)), l = 0;
                else
#pragma GCC ivdep
                    for (Size t = 0; t < n; t++)
                        to[t] = f[t] * v[t] + f[column + t] * v[component + t] +
                                f[2 * column + t] * v[2 * component + t];
                for (; l < c; l++)
#pragma GCC ivdep
                    for (Size t = 0; t < n; t++)
                        to[t] += f[l * column + t] * v[l * component + t];
            }
    }
}

/* Twists (p, 6) seen from frames (p, 4, 4). */
static void carry_all(Size p, const double *frames, const double *twists, double *out)
{
    for (; p--; frames += 16, twists += 6, out += 6) {
        const double x = frames[3], y = frames[7], z = frames[11];
        for (int i = 0; i < 3; i++) {
            const double *r = frames + 4 * i;
            out[i] = r[0] * twists[0] + r[1] * twists[1] + r[2] * twists[2];
            out[3 + i] = r[0] * twists[3] + r[1] * twists[4] + r[2] * twists[5];
        }
        out[0] += y * out[5] - z * out[4];
        out[1] += z * out[3] - x * out[5];
        out[2] += x * out[4] - y * out[3];
    }
}

/* ---- rotations ---- */

/* Rotation vectors (3, m) of matrices (3, 3, m); how many are by so obtuse an angle that it takes more care. */
WIDEST static Size rotation_vectors(Size m, const double *turns, Size row, Size column, double *out, Size axis)
{
    Size obtuse = 0;
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        double sine[SAMPLES], cosine[SAMPLES];
        const double *r = turns + start;
        double *v = out + start;
#pragma GCC ivdep
        for (Size t = 0; t < n; t++) {
            const double x = r[2 * row + column + t] - r[row + 2 * column + t];
            const double y = r[2 * column + t] - r[2 * row + t];
            const double z = r[row + t] - r[column + t];
            v[t] = x, v[axis + t] = y, v[2 * axis + t] = z;
            sine[t] = sqrt(fmax(x * x + y * y + z * z, 1e-300));
            cosine[t] = r[t] + r[row + column + t] + r[2 * (row + column) + t] - 1;
        }
        for (Size t = 0; t < n; t++) {
            const double f = atan2(sine[t], cosine[t]) / sine[t];
            v[t] *= f, v[axis + t] *= f, v[2 * axis + t] *= f;
            obtuse += cosine[t] < -1.8;
        }
    }
    return obtuse;
}

/* Inverse right Jacobians (3, 3, m) of rotation vectors (3, m): I + [v]/2 + f [v]^2. */
WIDEST static void jacobian_inverses(Size m, const double *vectors, Size axis, double *out, Size row, Size column)
{
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        double square[SAMPLES], f[SAMPLES];
        const double *v = vectors + start;
        double *to = out + start;
        for (Size t = 0; t < n; t++) {
            const double x = v[t], y = v[axis + t], z = v[2 * axis + t], s = x * x + y * y + z * z;
            square[t] = s;
            f[t] = 1.0 / 12 + s * (1.0 / 720 + s / 30240);
        }
        for (Size t = 0; t < n; t++)
            if (!(square[t] < 1e-3)) {
                const double angle = sqrt(square[t]);
                f[t] = 1 / square[t] - 0.5 / (angle * tan(0.5 * angle));
            }
#pragma GCC ivdep
        for (Size t = 0; t < n; t++) {
            const double x = v[t], y = v[axis + t], z = v[2 * axis + t], rest = 1 - f[t] * square[t];
            const double xy = f[t] * x * y, xz = f[t] * x * z, yz = f[t] * y * z;
            to[t] = rest + f[t] * x * x;
            to[column + t] = xy - 0.5 * z;
            to[2 * column + t] = xz + 0.5 * y;
            to[row + t] = xy + 0.5 * z;
            to[row + column + t] = rest + f[t] * y * y;
            to[row + 2 * column + t] = yz - 0.5 * x;
            to[2 * row + t] = xz - 0.5 * y;
            to[2 * row + column + t] = yz + 0.5 * x;
            to[2 * (row + column) + t] = rest + f[t] * z * z;
        }
    }
}

/* ---- reduction ---- */

/* The reflection that takes a column v of lanes below `*top` of a triangle into it: with the column as it was,
   [top; a] becomes [top - w; a - scale·w·v] with w = tau·(top + scale·v·a) for any other [top; a]. */
typedef struct {
    double tau, scale;
} Reflection;

static inline __attribute__((always_inline)) double sum(Lanes a)
{
    return (a[0] + a[2]) + (a[1] + a[3]);
}

static inline __attribute__((always_inline)) double dot(const Lanes *a, const Lanes *b, Size count)
{
    Lanes even = {0}, odd = {0};
    for (Size t = 0; t < count; t += 2) {
        even += a[t] * b[t];
        odd += a[t + 1] * b[t + 1];
    }
    return sum(even + odd);
}

static inline __attribute__((always_inline)) Reflection reflection(double *top, const Lanes *v, Size count)
{
    const double below = dot(v, v, count), before = *top;
    if (below == 0)
        return (Reflection){0, 0};
    const double norm = sqrt(before * before + below), beta = before > 0 ? -norm : norm;
    *top = beta;
    return (Reflection){(beta - before) / beta, 1 / (before - beta)};
}

/* Takes the rows of a block, `count` lanes a column, into the triangle r (c, c) above them. Two columns are
   reflected at a time, so that every other one is read and written half as often. */
WIDEST static void fold(double *restrict r, Lanes *restrict block, Size c, Size count)
{
    for (Size j = 0; j < c; j += 2) {
        const Lanes *v = block + j * count;
        double *first = r + j * c, *second = first + c;
        const Reflection one = reflection(first + j, v, count);
        if (j + 1 == c)
            break;
        Lanes *u = block + (j + 1) * count;
        const double w = one.tau * (first[j + 1] + one.scale * dot(v, u, count));
        first[j + 1] -= w;
        for (Size t = 0; t < count; t++)
            u[t] -= w * one.scale * v[t];
        const Reflection two = reflection(second + j + 1, u, count);
        const double both = dot(v, u, count);
        Size l = j + 2;
#define REFLECT(k, av, au, f, g)                                                                               \
    const double x##k = one.tau * (first[l + k] + one.scale * sum(av)), f = x##k * one.scale;                   \
    const double y##k = two.tau * (second[l + k] + two.scale * (sum(au) - f * both)), g = y##k * two.scale;     \
    first[l + k] -= x##k, second[l + k] -= y##k;
        for (; l + 3 < c; l += 4) {
            Lanes *a = block + l * count, *b = a + count, *d = b + count, *e = d + count;
            Lanes av = {0}, bv = {0}, dv = {0}, ev = {0}, au = {0}, bu = {0}, du = {0}, eu = {0};
            for (Size t = 0; t < count; t++) {
                av += v[t] * a[t], bv += v[t] * b[t], dv += v[t] * d[t], ev += v[t] * e[t];
                au += u[t] * a[t], bu += u[t] * b[t], du += u[t] * d[t], eu += u[t] * e[t];
            }
            REFLECT(0, av, au, fa, ga)
            REFLECT(1, bv, bu, fb, gb)
            REFLECT(2, dv, du, fd, gd)
            REFLECT(3, ev, eu, fe, ge)
            for (Size t = 0; t < count; t++) {
                const Lanes vt = v[t], ut = u[t];
                a[t] -= fa * vt + ga * ut;
                b[t] -= fb * vt + gb * ut;
                d[t] -= fd * vt + gd * ut;
                e[t] -= fe * vt + ge * ut;
            }
        }
        for (; l < c; l++) {
            Lanes *a = block + l * count, av = {0}, au = {0};
            for (Size t = 0; t < count; t++)
                av += v[t] * a[t], au += u[t] * a[t];
            REFLECT(0, av, au, f, g)
            for (Size t = 0; t < count; t++)
                a[t] -= f * v[t] + g * u[t];
        }
#undef REFLECT
    }
}

/* Rows on their way into a triangle, gathered to blocks that stay in the nearest cache. */
typedef struct {
    double *triangle;
    Lanes *block;
    Size columns, held;
} Fold;

static void flush(Fold *f)
{
    if (!f->held)
        return;
    const Size room = (f->held + 2 * LANES - 1) / (2 * LANES) * 2 * LANES;
    double *block = (double *)f->block;
    /* Columns lie ROWS apart while they are gathered, and side by side when they are reflected. */
    for (Size j = 0; j < f->columns; j++) {
        memmove(block + j * room, block + j * ROWS, f->held * sizeof(double));
        memset(block + j * room + f->held, 0, (room - f->held) * sizeof(double));
    }
    fold(f->triangle, f->block, f->columns, room / LANES);
    f->held = 0;
}

/* Adds n rows, of which each used column is contiguous; the others are zero. */
static void gather(Fold *f, const double *rows, Size stride, const Size *used, Size n)
{
    for (Size done = 0; done < n;) {
        const Size some = n - done < ROWS - f->held ? n - done : ROWS - f->held;
        for (Size j = 0; j < f->columns; j++)
            memcpy((double *)f->block + j * ROWS + f->held, rows + used[j] * stride + done,
                   some * sizeof(double));
        f->held += some, done += some;
        if (f->held == ROWS)
            flush(f);
    }
}

static int empty(const double *column, Size n)
{
    for (Size t = 0; t < n; t++)
        if (column[t] != 0)
            return 0;
    return 1;
}

/* The triangle r (c, c) of rows (c, k, m): those of the k readings that are zero in the same columns are
   reduced without these. `work` holds k + 2 times c sizes, `part` c times c doubles. */
static void reduce(const double *rows, Size c, Size k, Size m, Size column, Size reading, double *r, Lanes *block,
                   Size *work, double *part)
{
    Size *counts = work, *used = work + k;
    memset(r, 0, c * c * sizeof(double));
    for (Size i = 0; i < k; i++) {
        counts[i] = 0;
        for (Size j = 0; j < c; j++)
            if (!empty(rows + j * column + i * reading, m))
                used[i * c + counts[i]++] = j;
    }
    Fold whole = {r, block, c, 0};
    for (Size i = 0; i < k; i++) {
        const Size u = counts[i], *mine = used + i * c;
        if (u == 0 || u > c)
            continue;
        double *into = u == c ? r : part;
        if (u < c)
            memset(part, 0, u * u * sizeof(double));
        Fold some = {into, block, u, 0};
        for (Size l = i; l < k; l++)
            if (counts[l] == u && !memcmp(used + l * c, mine, u * sizeof(Size))) {
                gather(&some, rows + l * reading, column, l == i ? mine : used + l * c, m);
                if (l > i)
                    counts[l] = 0;
            }
        flush(&some);
        if (u == c)
            continue;
        for (Size row = 0; row < u; row++) {
            double *at = (double *)block + whole.held;
            for (Size j = 0; j < c; j++)
                at[j * ROWS] = 0;
            for (Size j = row; j < u; j++)
                at[mine[j] * ROWS] = part[row * u + j];
            if (++whole.held == ROWS)
                flush(&whole);
        }
        flush(&whole);
    }
}

/* ---- Python ---- */

/* What a function takes: an array's name, number of axes, and type: d double, s size, ? truth, D doubles that
   are written. */
typedef struct {
    const char *name;
    int axes;
    char type;
} Wanted;

/* An array with its last axis contiguous, its strides in items. */
typedef struct {
    Py_buffer view;
    void *data;
    Size stride[4];
} Array;

static void release(Array *a, Size count)
{
    while (count--)
        PyBuffer_Release(&a[count].view);
}

static int take(Array *a, PyObject *from, Wanted wanted)
{
    const int written = wanted.type == 'D';
    if (PyObject_GetBuffer(from, &a->view, PyBUF_STRIDES | PyBUF_FORMAT | (written ? PyBUF_WRITABLE : 0)) < 0)
        return 0;
    const Py_buffer *v = &a->view;
    const char *format = v->format ? v->format : "";
    const char *right = wanted.type == '?' ? "?" : wanted.type == 's' ? "lqn" : "d";
    const Size size = wanted.type == '?' ? 1 : 8;
    int fine = v->ndim == wanted.axes && v->itemsize == size && *format && strchr(right, *format);
    for (int i = 0; fine && i < v->ndim; i++) {
        a->stride[i] = v->strides[i] / size;
        fine = v->strides[i] % size == 0 && (i < v->ndim - 1 || a->stride[i] == 1 || v->shape[i] < 2);
    }
    a->data = v->buf;
    if (!fine) {
        PyErr_Format(PyExc_ValueError, "%s: wants %d axes of %s, the last one contiguous", wanted.name,
                     wanted.axes, right);
        PyBuffer_Release(&a->view);
    }
    return fine;
}

/* Takes all arguments, or none and sets the error. */
static int take_all(Array *a, PyObject *args, const Wanted *wanted, Size count)
{
    if (PyTuple_Size(args) != count) {
        PyErr_Format(PyExc_TypeError, "takes %zd arrays", count);
        return 0;
    }
    for (Size i = 0; i < count; i++)
        if (!take(a + i, PyTuple_GetItem(args, i), wanted[i])) {
            release(a, i);
            return 0;
        }
    return 1;
}

static int is_shaped(const Array *a, Size first, Size second, Size third, Size fourth)
{
    const Size shape[] = {first, second, third, fourth};
    for (int i = 0; i < a->view.ndim; i++)
        if (a->view.shape[i] != shape[i])
            return 0;
    return 1;
}

/* Whether all axes are contiguous. */
static int is_packed(const Array *a)
{
    Size step = 1;
    for (int i = a->view.ndim; i--; step *= a->view.shape[i])
        if (a->stride[i] != step && a->view.shape[i] > 1)
            return 0;
    return 1;
}

static PyObject *answer(Array *a, Size count, int fine)
{
    release(a, count);
    if (fine)
        Py_RETURN_NONE;
    if (!PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "the arrays' shapes do not go together");
    return NULL;
}

static PyObject *carry_frames(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"links", 3, 'd'}, {"prismatic", 1, '?'}, {"values", 2, 'd'},
                                    {"cos", 2, 'd'},   {"sin", 2, 'd'},       {"frames", 4, 'D'}};
    Array a[6];
    if (!take_all(a, args, wanted, 6))
        return NULL;
    const Array *links = a, *values = a + 2, *frames = a + 5;
    const Size k = values->view.shape[0], m = values->view.shape[1];
    int fine = is_shaped(links, k + 1, 4, 4, 0) && is_shaped(a + 1, k, 0, 0, 0) && is_shaped(a + 3, k, m, 0, 0) &&
               is_shaped(a + 4, k, m, 0, 0) && is_shaped(frames, k + 2, frames->view.shape[1], 3, m) &&
               frames->view.shape[1] >= 4 && frames->stride[1] == 3 * frames->stride[2];
    for (int i = 0; i < 5; i++)
        fine = fine && is_packed(a + i);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        carry(k + 1, m, links->data, a[1].data, values->data, a[3].data, a[4].data, frames->data, frames->stride[0],
              frames->stride[2]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 6, fine);
}

static PyObject *point_velocities(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {
        {"frames", 4, 'd'}, {"point", 2, 'd'}, {"at", 1, 's'}, {"twists", 2, 'd'}, {"out", 3, 'D'}};
    Array a[5];
    if (!take_all(a, args, wanted, 5))
        return NULL;
    const Array *frames = a, *point = a + 1, *at = a + 2, *out = a + 4;
    const Size p = at->view.shape[0], m = point->view.shape[1];
    int fine = is_shaped(frames, frames->view.shape[0], frames->view.shape[1], 3, m) &&
               frames->view.shape[1] >= 4 && frames->stride[1] == 3 * frames->stride[2] &&
               is_shaped(point, 3, m, 0, 0) && is_shaped(a + 3, p, 6, 0, 0) && is_packed(a + 3) &&
               is_shaped(out, p, 6, m, 0);
    const Size *bodies = at->data;
    for (Size i = 0; fine && i < p; i++)
        fine = bodies[i] >= 0 && bodies[i] < frames->view.shape[0];
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        velocities(p, m, frames->data, frames->stride[0], frames->stride[2], point->data, point->stride[0], bodies,
                   a[3].data, out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 5, fine);
}

static PyObject *mix_samples(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"vectors", 3, 'd'}, {"matrices", 3, 'd'}, {"out", 3, 'D'}};
    Array a[3];
    if (!take_all(a, args, wanted, 3))
        return NULL;
    const Array *vectors = a, *matrices = a + 1, *out = a + 2;
    const Size p = vectors->view.shape[0], c = vectors->view.shape[1], m = vectors->view.shape[2];
    const Size k = matrices->view.shape[0];
    const int fine = is_shaped(matrices, k, c, m, 0) && is_shaped(out, p, k, m, 0);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        mix(p, k, c, m, vectors->data, vectors->stride[0], vectors->stride[1], matrices->data, matrices->stride[0],
            matrices->stride[1], out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 3, fine);
}

static PyObject *carry_twists(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"frames", 3, 'd'}, {"twists", 2, 'd'}, {"out", 2, 'D'}};
    Array a[3];
    if (!take_all(a, args, wanted, 3))
        return NULL;
    const Size p = a->view.shape[0];
    int fine = is_shaped(a, p, 4, 4, 0) && is_shaped(a + 1, p, 6, 0, 0) && is_shaped(a + 2, p, 6, 0, 0);
    for (int i = 0; i < 3; i++)
        fine = fine && is_packed(a + i);
    if (fine)
        carry_all(p, a->data, a[1].data, a[2].data);
    return answer(a, 3, fine);
}

static PyObject *log_rotations(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"turns", 3, 'd'}, {"out", 2, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Size m = a->view.shape[2];
    if (!is_shaped(a, 3, 3, m, 0) || !is_shaped(a + 1, 3, m, 0, 0))
        return answer(a, 2, 0);
    const Size obtuse = rotation_vectors(m, a->data, a->stride[0], a->stride[1], a[1].data, a[1].stride[0]);
    release(a, 2);
    return PyLong_FromSsize_t(obtuse);
}

static PyObject *right_jacobian_inverses(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"vectors", 2, 'd'}, {"out", 3, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Size m = a->view.shape[1];
    const int fine = is_shaped(a, 3, m, 0, 0) && is_shaped(a + 1, 3, 3, m, 0);
    if (fine)
        jacobian_inverses(m, a->data, a->stride[0], a[1].data, a[1].stride[0], a[1].stride[1]);
    return answer(a, 2, fine);
}

static PyObject *triangles(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"rows", 4, 'd'}, {"out", 3, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Py_buffer *rows = &a->view;
    const Size b = rows->shape[0], c = rows->shape[1], k = rows->shape[2], m = rows->shape[3];
    int fine = is_shaped(a + 1, b, c, c, 0) && is_packed(a + 1);
    if (fine) {
        Lanes *block = aligned_alloc(64, (c + 1) * ROWS * sizeof(double));
        double *part = malloc((c * c + 1) * sizeof(double));
        Size *work = malloc((k * (c + 1) + 1) * sizeof(Size));
        fine = block && part && work;
        if (fine) {
            Py_BEGIN_ALLOW_THREADS;
            for (Size i = 0; i < b; i++)
                reduce((double *)a->data + i * a->stride[0], c, k, m, a->stride[1], a->stride[2],
                       (double *)a[1].data + i * c * c, block, work, part);
            Py_END_ALLOW_THREADS;
        } else
            PyErr_NoMemory();
        free(block), free(part), free(work);
    }
    return answer(a, 2, fine);
}

static PyMethodDef methods[] = {
    {"carry_frames", carry_frames, METH_VARARGS, NULL},
    {"point_velocities", point_velocities, METH_VARARGS, NULL},
    {"mix_samples", mix_samples, METH_VARARGS, NULL},
    {"carry_twists", carry_twists, METH_VARARGS, NULL},
    {"log_rotations", log_rotations, METH_VARARGS, NULL},
    {"right_jacobian_inverses", right_jacobian_inverses, METH_VARARGS, NULL},
    {"triangles", triangles, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyModuleDef_Slot slots[] = {{0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, .m_name = "_kernel", .m_size = 0, .m_methods = methods, .m_slots = slots};

PyMODINIT_FUNC PyInit__kernel(void)
{
    return PyModuleDef_Init(&module);
}
