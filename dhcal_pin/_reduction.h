/* Triangles of tall rows. */

/* The reflection that takes a column v of lanes below `*top` of a triangle into it: with the column as it
   was, [top; a] becomes [top - w; a - scale·w·v] with w = tau·(top + scale·v·a) for any other [top; a]. */
typedef struct {
    double tau, scale;
} Reflection;

static inline __attribute__((always_inline)) double sum(const Lanes *a)
{
    return ((*a)[0] + (*a)[2]) + ((*a)[1] + (*a)[3]);
}

static inline __attribute__((always_inline)) double dot(const Lanes *a, const Lanes *b, Size count)
{
    Lanes even = {0}, odd = {0};
    for (Size t = 0; t < count; t += 2) {
        even += a[t] * b[t];
        odd += a[t + 1] * b[t + 1];
    }
    even += odd;
    return sum(&even);
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
#define REFLECT(k, av, au, f, g)                                                                             \
    const double x##k = one.tau * (first[l + k] + one.scale * sum(&av)), f = x##k * one.scale;               \
    const double y##k = two.tau * (second[l + k] + two.scale * (sum(&au) - f * both)), g = y##k * two.scale; \
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
   reduced without these. Half the errors of an arm are lengths, which turn nothing: a quarter of the work for
   rows of rotations. There is room for c by ROWS in `block`, k by c + 1 in `work`, c by c in `part`. */
static void reduce(const double *rows, Size c, Size k, Size m, Size column, Size reading, double *r,
                   Lanes *block, Size *work, double *part)
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
        if (u == 0)
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
