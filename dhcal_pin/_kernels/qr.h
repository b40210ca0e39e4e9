/* Triangles of tall rows. */

/* With a column v below `top` as it was before, [above; a] becomes [above - w; a - scale·w·v] with
   w = tau·(above + scale·v·a) for any other column. */
typedef struct {
    double tau, scale;
} Reflection;

/* The reflection that takes what is below `*top`, of which the sum of squares is given, into it. */
static inline __attribute__((always_inline)) Reflection reflection(double *top, double below)
{
    const double before = *top;
    if (below == 0)
        return (Reflection){0, 0};
    const double norm = sqrt(before * before + below), beta = before > 0 ? -norm : norm;
    *top = beta;
    return (Reflection){(beta - before) / beta, 1 / (before - beta)};
}

static inline __attribute__((always_inline)) double sum(const Lanes *a)
{
    return ((*a)[0] + (*a)[2]) + ((*a)[1] + (*a)[3]);
}

/* Does two reflections, of columns v and u with the product `both`, to some columns side by side with `first`
   and `second` above them. */
static inline __attribute__((always_inline)) void reflect(const int columns, double *restrict first,
                                                          double *restrict second, Lanes *restrict a,
                                                          const Lanes *restrict v, const Lanes *restrict u,
                                                          Size count, Reflection one, Reflection two,
                                                          double both)
{
    Lanes av[WIDTH] = {{0}}, au[WIDTH] = {{0}};
    double f[WIDTH], g[WIDTH];
    for (Size t = 0; t < count; t++)
        for (int k = 0; k < columns; k++) {
            const Lanes at = a[k * count + t];
            av[k] += v[t] * at, au[k] += u[t] * at;
        }
    for (int k = 0; k < columns; k++) {
        const double x = one.tau * (first[k] + one.scale * sum(&av[k]));
        f[k] = x * one.scale;
        const double y = two.tau * (second[k] + two.scale * (sum(&au[k]) - f[k] * both));
        g[k] = y * two.scale;
        first[k] -= x, second[k] -= y;
    }
    for (Size t = 0; t < count; t++)
        for (int k = 0; k < columns; k++)
            a[k * count + t] -= f[k] * v[t] + g[k] * u[t];
}

/* Takes the rows of a block, `count` lanes a column, an even number, into the triangle r (c, c) above them.
   Two columns are reflected at a time, so that every other one is read and written half as often. */
WIDEST static void fold(double *restrict r, Lanes *restrict block, Size c, Size count)
{
    for (Size j = 0; j < c; j += 2) {
        Lanes *v = block + j * count, *u = j + 1 < c ? v + count : v;
        double *first = r + j * c, *second = first + c;
        Lanes vv[2] = {{0}}, vu[2] = {{0}}, uu[2] = {{0}};
        for (Size t = 0; t < count; t += 2)
            for (int i = 0; i < 2; i++)
                vv[i] += v[t + i] * v[t + i], vu[i] += v[t + i] * u[t + i];
        vv[0] += vv[1], vu[0] += vu[1];
        const Reflection one = reflection(first + j, sum(vv));
        if (j + 1 == c)
            break;
        const double w = one.tau * (first[j + 1] + one.scale * sum(vu)), f = w * one.scale;
        first[j + 1] -= w;
        vu[0] = vu[1] = uu[0];
        for (Size t = 0; t < count; t += 2)
            for (int i = 0; i < 2; i++) {
                const Lanes left = u[t + i] - f * v[t + i];
                uu[i] += left * left, vu[i] += left * v[t + i];
                u[t + i] = left;
            }
        uu[0] += uu[1], vu[0] += vu[1];
        const Reflection two = reflection(second + j + 1, sum(uu));
        const double both = sum(vu);
        for (Size l = j + 2, left; (left = c - l) > 0;) {
            /* As evenly as it goes. */
            const Size parts = (left + WIDTH - 1) / WIDTH, columns = (left + parts - 1) / parts;
#define REFLECT(n)                                                                                           \
    case n:                                                                                                  \
        reflect(n, first + l, second + l, block + l * count, v, u, count, one, two, both);                   \
        break;
            switch (columns) {
                REFLECT(1)
                REFLECT(2)
                REFLECT(3)
                REFLECT(4)
                REFLECT(5)
                REFLECT(6)
            }
#undef REFLECT
            l += columns;
        }
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

/* Adds n rows of columns that lie ROWS apart. */
static void gather(Fold *f, const double *rows, Size n)
{
    for (Size done = 0; done < n;) {
        const Size some = n - done < ROWS - f->held ? n - done : ROWS - f->held;
        for (Size j = 0; j < f->columns; j++)
            memcpy((double *)f->block + j * ROWS + f->held, rows + j * ROWS + done, some * sizeof(double));
        f->held += some, done += some;
        if (f->held == ROWS)
            flush(f);
    }
}

static inline __attribute__((always_inline)) int empty(const double *row, Size n)
{
    const Bits *bits = (const Bits *)row;
    for (Size start = 0; start < n; start += SAMPLES) {
        const Size some = n - start < SAMPLES ? n - start : SAMPLES;
        Bits any = 0;
        for (Size t = 0; t < some; t++)
            any |= bits[start + t];
        /* But for the sign. */
        if (any << 1)
            return 0;
    }
    return 1;
}

/* Which of c columns each of k readings has: how many, which, where a column stands among them or -1, and the
   first reading that has the same. */
typedef struct {
    Size *counts, *columns, *places, *alike;
} Used;

static int list_used(Used *used, const Errors *e, const Mixture *x, const double *given, Size c, Size k,
                     Size m, Size column, Size reading)
{
    used->counts = calloc(2 * k * (c + 1) + 1, sizeof(Size));
    if (!used->counts)
        return 0;
    used->alike = used->counts + k, used->columns = used->alike + k, used->places = used->columns + k * c;
    for (Size i = 0; i < k; i++) {
        Size *mine = used->columns + i * c, *place = used->places + i * c, u = 0;
        const Seen by = seen_by(x, i);
        for (Size j = 0; j < c; j++) {
            const double *rows = given + (j - e->count) * column + i * reading;
            const int some = j < e->count ? is_seen(e, j, by) : !empty(rows, m);
            place[j] = some ? u : -1;
            if (some)
                mine[u++] = j;
        }
        used->counts[i] = u;
        Size first = 0;
        while (used->counts[first] != u || memcmp(used->columns + first * c, mine, u * sizeof(Size)))
            first++;
        used->alike[i] = first;
    }
    return 1;
}

/* Where lanes may lie. */
static double *aligned(double *room)
{
    return room + (64 - (uintptr_t)room % 64) % 64 / sizeof(double);
}

/* Doubles of memory that `reduce` works in. */
static Size room_for(Size c, Size k, Size ends)
{
    return (k + 1) * c * ROWS + 9 * ends * ROWS + k * c * c + 8;
}

/* The triangle r (c, c) of rows (c, k, m), the first columns by errors and the others given: those of the k
   readings that are zero in the same columns are reduced without these. Half the errors of an arm are
   lengths, which turn nothing: a quarter of the work for rows of rotations. */
static int reduce(const Errors *e, const Mixture *x, const double *given, Size c, Size k, Size m, Size column,
                  Size reading, double *r, double *room)
{
    Used used;
    if (!list_used(&used, e, x, given, c, k, m, column, reading))
        return 0;
    /* Of each reading a block of rows, one of rows of several, velocities, and triangles of like readings. */
    double *blocks = aligned(room);
    Lanes *spare = (Lanes *)(blocks + k * c * ROWS);
    double *moved = (double *)spare + c * ROWS, *triangles = moved + 9 * e->ends * ROWS;
    memset(r, 0, c * c * sizeof(double));
    for (Size i = 0; i < k; i++)
        if (used.alike[i] == i && used.counts[i] < c)
            memset(triangles + i * c * c, 0, used.counts[i] * used.counts[i] * sizeof(double));
    for (Size start = 0; start < m; start += ROWS) {
        const Size n = m - start < ROWS ? m - start : ROWS;
        mix_errors(e, x, start, n, c, used.places, moved, blocks);
        for (Size i = 0; i < k; i++) {
            const Size u = used.counts[i];
            if (used.alike[i] != i || !u)
                continue;
            Fold some = {u == c ? r : triangles + i * c * c, spare, u, 0};
            for (Size l = i; l < k; l++) {
                if (used.alike[l] != i)
                    continue;
                double *block = blocks + l * c * ROWS;
                for (Size j = u; j-- && used.columns[i * c + j] >= e->count;)
                    memcpy(block + j * ROWS,
                           given + (used.columns[i * c + j] - e->count) * column + l * reading + start,
                           n * sizeof(double));
                if (n == ROWS)
                    fold(some.triangle, (Lanes *)block, u, ROWS / LANES);
                else
                    gather(&some, block, n);
            }
            flush(&some);
        }
    }
    Fold whole = {r, spare, c, 0};
    for (Size i = 0; i < k; i++) {
        const Size u = used.counts[i];
        if (used.alike[i] != i || u == c)
            continue;
        for (Size row = 0; row < u; row++) {
            double *at = (double *)spare + whole.held;
            for (Size j = 0; j < c; j++) {
                const Size place = used.places[i * c + j];
                at[j * ROWS] = place < row ? 0 : triangles[i * c * c + row * u + place];
            }
            if (++whole.held == ROWS)
                flush(&whole);
        }
        flush(&whole);
    }
    free(used.counts);
    return 1;
}

/* The triangle r (p + 1, p + 1) of another one and of rows below it: a diagonal (p) and what they are to be.
 */
static void add_diagonal(const double *triangle, Size p, const double *diagonal, const double *right,
                         double *r, double *room)
{
    const Size c = p + 1;
    double *block = aligned(room);
    memcpy(r, triangle, c * c * sizeof(double));
    for (Size start = 0; start < p; start += ROWS) {
        const Size n = p - start < ROWS ? p - start : ROWS;
        const Size rows = (n + 2 * LANES - 1) / (2 * LANES) * 2 * LANES;
        memset(block, 0, c * rows * sizeof(double));
        for (Size i = 0; i < n; i++) {
            block[(start + i) * rows + i] = diagonal[start + i];
            block[p * rows + i] = right[start + i];
        }
        fold(r, (Lanes *)block, c, rows / LANES);
    }
}
