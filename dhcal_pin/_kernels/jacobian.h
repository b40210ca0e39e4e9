/* How an arm's errors move the tool, and what of that readings see. */

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
        EACH (t, n)
            out[t] = f * x[t];
    } else if (count == 2) {
        const double f = vector[given[0]], g = vector[given[1]];
        EACH (t, n)
            out[t] = f * x[t] + g * y[t];
    } else {
        const double f = vector[0], g = vector[1], h = vector[2];
        EACH (t, n)
            out[t] = f * x[t] + g * y[t] + h * z[t];
    }
}

/* Where the point is from a body's origin at n samples, along the measuring frame's axes (3, ROWS). */
static inline __attribute__((always_inline)) void reach(double *lever, const double *point, Size point_row,
                                                        const double *frame, Size row, Size n)
{
    for (Size i = 0; i < 3; i++) {
        const double *restrict p = point + i * point_row, *restrict o = frame + (9 + i) * row;
        double *restrict to = lever + i * ROWS;
        EACH (t, n)
            to[t] = p[t] - o[t];
    }
}

static inline __attribute__((always_inline)) int turns(const double *twist)
{
    return twist[3] != 0 || twist[4] != 0 || twist[5] != 0;
}

/* The point's velocity (6, n) by a twist of a body. */
static inline __attribute__((always_inline)) void velocity(double *out, Size out_row, const double *frame,
                                                           Size row, const double *twist, const double *lever,
                                                           Size n)
{
    for (Size i = 0; i < 3; i++)
        turned(out + (3 + i) * out_row, frame + i * row, row, twist + 3, n);
    for (Size i = 0; i < 3; i++)
        turned(out + i * out_row, frame + i * row, row, twist, n);
    if (turns(twist))
        for (Size i = 0; i < 3; i++) {
            const Size y = (i + 1) % 3, z = (i + 2) % 3;
            const double *restrict wy = out + (3 + y) * out_row, *restrict wz = out + (3 + z) * out_row;
            const double *restrict ly = lever + y * ROWS, *restrict lz = lever + z * ROWS;
            double *restrict v = out + i * out_row;
            EACH (t, n)
                v[t] += wy[t] * lz[t] - wz[t] * ly[t];
        }
}

/* Errors of an arm: each is a twist of a body, which moves a point, at samples of some ends each, the second
   ends so many samples behind the first. */
typedef struct {
    Size count, ends, apart;
    const Size *at;
    const double *twists, *frames, *point;
    Size body, row, point_row;
} Errors;

WIDEST static void velocities(const Errors *e, Size m, double *out, Size out_twist, Size out_row)
{
    double lever[3 * ROWS];
    for (Size start = 0; start < m; start += ROWS) {
        const Size n = m - start < ROWS ? m - start : ROWS;
        for (Size j = 0; j < e->count; j++) {
            const double *frame = e->frames + e->at[j] * e->body + start;
            if (!j || e->at[j] != e->at[j - 1])
                reach(lever, e->point + start, e->point_row, frame, e->row, n);
            velocity(out + j * out_twist + start, out_row, frame, e->row, e->twists + 6 * j, lever, n);
        }
    }
}

/* How rows follow from velocities: each term adds a share (m) of a component, 0 to 5 at the first end, 6 to
   11 at the second, to a row. Terms of a row are neighbours. */
typedef struct {
    Size count;
    const Size *rows, *components;
    const double *shares;
    Size stride;
} Mixture;

/* Whether a row sees what moves, and what turns. */
typedef struct {
    int moves, turns;
} Seen;

static Seen seen_by(const Mixture *x, Size row)
{
    Seen out = {0, 0};
    for (Size q = 0; q < x->count; q++)
        if (x->rows[q] == row)
            *(x->components[q] % 6 < 3 ? &out.moves : &out.turns) = 1;
    return out;
}

static int is_seen(const Errors *e, Size error, Seen by)
{
    const double *twist = e->twists + 6 * error;
    if (turns(twist))
        return by.moves || by.turns;
    return by.moves && (twist[0] != 0 || twist[1] != 0 || twist[2] != 0);
}

/* One row of the mixture, from its term q on, of velocities with components at a stride and ends at another;
   the first term that is no more of that row. */
static inline __attribute__((always_inline)) Size mix_row(double *restrict out, const Mixture *x, Size q,
                                                          const double *velocity, Size component, Size end,
                                                          int is_turning, Size start, Size n)
{
    const Size row = x->rows[q];
    int begun = 0;
    while (q < x->count && x->rows[q] == row) {
        const double *f[3] = {0}, *v[3] = {0};
        int some = 0;
        for (; q < x->count && x->rows[q] == row && some < 3; q++) {
            const Size which = x->components[q] % 6;
            if (which > 2 && !is_turning)
                continue;
            f[some] = x->shares + q * x->stride + start;
            v[some++] = velocity + which * component + x->components[q] / 6 * end;
        }
        const double *restrict f0 = f[0], *restrict f1 = f[1], *restrict f2 = f[2];
        const double *restrict v0 = v[0], *restrict v1 = v[1], *restrict v2 = v[2];
        if (some == 3 && begun)
            EACH (t, n)
                out[t] += f0[t] * v0[t] + f1[t] * v1[t] + f2[t] * v2[t];
        else if (some == 3)
            EACH (t, n)
                out[t] = f0[t] * v0[t] + f1[t] * v1[t] + f2[t] * v2[t];
        else if (some == 1 && !begun)
            EACH (t, n)
                out[t] = f0[t] * v0[t];
        else {
            if (!begun)
                memset(out, 0, n * sizeof(double));
            for (int i = 0; i < some; i++) {
                const double *restrict fi = f[i], *restrict vi = v[i];
                EACH (t, n)
                    out[t] += fi[t] * vi[t];
            }
        }
        begun = 1;
    }
    return q;
}

/* Rows (p, k, m) of velocities (p, 6, ends m). */
WIDEST static void mix(const Mixture *x, Size p, Size k, Size m, const double *velocities, Size velocity,
                       Size component, double *out, Size out_error, Size out_row)
{
    for (Size start = 0; start < m; start += ROWS) {
        const Size n = m - start < ROWS ? m - start : ROWS;
        for (Size j = 0; j < p; j++)
            for (Size i = 0, q = 0; i < k; i++) {
                double *to = out + j * out_error + i * out_row + start;
                if (q < x->count && x->rows[q] == i)
                    q = mix_row(to, x, q, velocities + j * velocity + start, component, m, 1, start, n);
                else
                    memset(to, 0, n * sizeof(double));
            }
    }
}

/* Rows by errors at n samples into blocks of c columns ROWS apart, one block a reading, at the columns'
   places (k, c); `moved` has room for velocities and levers of all ends. */
WIDEST static void mix_errors(const Errors *e, const Mixture *x, Size start, Size n, Size c,
                              const Size *places, double *moved, double *blocks)
{
    double *levers = moved + 6 * e->ends * ROWS;
    for (Size j = 0; j < e->count; j++) {
        const double *twist = e->twists + 6 * j;
        for (Size end = 0; end < e->ends; end++) {
            const double *frame = e->frames + e->at[j] * e->body + end * e->apart + start;
            double *lever = levers + 3 * end * ROWS;
            if (!j || e->at[j] != e->at[j - 1])
                reach(lever, e->point + end * e->apart + start, e->point_row, frame, e->row, n);
            velocity(moved + 6 * end * ROWS, ROWS, frame, e->row, twist, lever, n);
        }
        for (Size q = 0; q < x->count;) {
            const Size row = x->rows[q], place = places[row * c + j];
            if (place >= 0)
                q = mix_row(blocks + (row * c + place) * ROWS, x, q, moved, ROWS, 6 * ROWS, turns(twist),
                            start, n);
            else
                while (q < x->count && x->rows[q] == row)
                    q++;
        }
    }
}
