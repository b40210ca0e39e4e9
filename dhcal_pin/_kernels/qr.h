/* R factor of a tall matrix: blocked Householder TSQR with paired reflectors.

   Sequential TSQR (J. Demmel, L. Grigori, M. Hoemmen, J. Langou: Communication-optimal parallel and
   sequential QR and LU factorizations, SIAM J. Sci. Comput. 34 (2012), A206-A239). The rows of the whitened
   Jacobian are generated in blocks B of at most BLOCK_ROWS rows that stay in the first-level cache, and each
   block updates the factor:

       R <- R factor of [R; B].

   R is upper triangular, so reflector j changes row j of R and the block, and no other row of R.

   Reflector of column j (as LAPACK dlarfg), with the diagonal entry α = R[j, j] and the column v of the
   block:

       β = -sign(α)·sqrt(α² + vᵀv),  τ = (β - α)/β,  s = 1/(α - β),  H = I - τ·[1; s·v]·[1; s·v]ᵀ,
       H·[α; v] = [β; 0],            H·[h; a] = [h - w; a - s·w·v]  with  w = τ·(h + s·vᵀa).

   Pair of reflectors. Columns j and j + 1 are eliminated together: v is column j, u is column j + 1 after the
   first reflector. For every later column a with the entries h1 = R[j, .] and h2 = R[j+1, .] above it

       x = τ1·(h1 + s1·vᵀa),                        f = s1·x,
       y = τ2·(h2 + s2·(uᵀa - f·uᵀv)),              g = s2·y,
       h1 <- h1 - x,  h2 <- h2 - y,  a <- a - f·v - g·u.

   Both inner products are computed in one pass and both updates in another, so that a is read and written
   half as often as with single reflectors. The product uᵀv is the same for all columns.

   Each lane of a vector has its own partial sum, and the partial sums are added in a fixed order. Hence no
   digit depends on the alignment of the data. */

/* τ and s of a Householder reflector. */
typedef struct {
    double tau, scale;
} Reflector;

/* Compute the reflector of a column with the entry *top and the squared norm vᵀv below it; *top becomes β. */
static inline __attribute__((always_inline)) Reflector make_reflector(double *top, double squared_norm)
{
    const double alpha = *top;
    if (squared_norm == 0)
        return (Reflector){0, 0};
    const double norm = sqrt(alpha * alpha + squared_norm), beta = alpha > 0 ? -norm : norm;
    *top = beta;
    return (Reflector){(beta - alpha) / beta, 1 / (alpha - beta)};
}

static inline __attribute__((always_inline)) double sum_lanes(const Lanes *a)
{
    return ((*a)[0] + (*a)[2]) + ((*a)[1] + (*a)[3]);
}

/* Apply the reflectors `one` of v and `two` of u to adjacent columns a (columns, count) below `first` and
   `second`.

   `uv` is uᵀv. */
static inline __attribute__((always_inline)) void
apply_reflector_pair(const int columns, double *restrict first, double *restrict second, Lanes *restrict a,
                     const Lanes *restrict v, const Lanes *restrict u, Size count, Reflector one,
                     Reflector two, double uv)
{
    Lanes av[MAX_COLUMNS] = {{0}}, au[MAX_COLUMNS] = {{0}};
    double f[MAX_COLUMNS], g[MAX_COLUMNS];
    for (Size t = 0; t < count; t++)
        for (int k = 0; k < columns; k++) {
            const Lanes at = a[k * count + t];
            av[k] += v[t] * at, au[k] += u[t] * at;
        }
    for (int k = 0; k < columns; k++) {
        const double x = one.tau * (first[k] + one.scale * sum_lanes(&av[k]));
        f[k] = x * one.scale;
        const double y = two.tau * (second[k] + two.scale * (sum_lanes(&au[k]) - f[k] * uv));
        g[k] = y * two.scale;
        first[k] -= x, second[k] -= y;
    }
    for (Size t = 0; t < count; t++)
        for (int k = 0; k < columns; k++)
            a[k * count + t] -= f[k] * v[t] + g[k] * u[t];
}

/* Whether n doubles are all zero, of either sign. */
static inline __attribute__((always_inline)) int is_zero(const double *row, Size n)
{
    const Bits *bits = (const Bits *)row;
    for (Size start = 0; start < n; start += BLOCK_SAMPLES) {
        const Size count = n - start < BLOCK_SAMPLES ? n - start : BLOCK_SAMPLES;
        Bits any = 0;
        for (Size t = 0; t < count; t++)
            any |= bits[start + t];
        /* The shift removes the sign bit. */
        if (any << 1)
            return 0;
    }
    return 1;
}

/* Replace r (c, c) by the R factor of [r; block] with `count` lanes per column, an even number; overwrite
   block. */
SIMD_CLONES static void update_r_factor(double *restrict r, Lanes *restrict block, Size c, Size count)
{
    for (Size j = 0; j < c; j += 2) {
        Lanes *v = block + j * count, *u = j + 1 < c ? v + count : v;
        double *first = r + j * c, *second = first + c;
        Lanes vv[2] = {{0}}, vu[2] = {{0}}, uu[2] = {{0}};
        /* Blocks of a triangular or diagonal matrix start with zero columns, which change nothing. */
        if (is_zero((const double *)v, (u - v + count) * LANES))
            continue;
        for (Size t = 0; t < count; t += 2)
            for (int i = 0; i < 2; i++)
                vv[i] += v[t + i] * v[t + i], vu[i] += v[t + i] * u[t + i];
        vv[0] += vv[1], vu[0] += vu[1];
        const Reflector one = make_reflector(first + j, sum_lanes(vv));
        if (j + 1 == c)
            break;
        const double w = one.tau * (first[j + 1] + one.scale * sum_lanes(vu)), f = w * one.scale;
        first[j + 1] -= w;
        vu[0] = vu[1] = uu[0];
        for (Size t = 0; t < count; t += 2)
            for (int i = 0; i < 2; i++) {
                const Lanes updated = u[t + i] - f * v[t + i];
                uu[i] += updated * updated, vu[i] += updated * v[t + i];
                u[t + i] = updated;
            }
        uu[0] += uu[1], vu[0] += vu[1];
        const Reflector two = make_reflector(second + j + 1, sum_lanes(uu));
        const double uv = sum_lanes(vu);
        for (Size l = j + 2, remaining; (remaining = c - l) > 0;) {
            /* Groups of nearly equal size, at most MAX_COLUMNS. */
            const Size groups = (remaining + MAX_COLUMNS - 1) / MAX_COLUMNS;
            const Size columns = (remaining + groups - 1) / groups;
#define APPLY_TO(n)                                                                                          \
    case n:                                                                                                  \
        apply_reflector_pair(n, first + l, second + l, block + l * count, v, u, count, one, two, uv);        \
        break;
            switch (columns) {
                APPLY_TO(1)
                APPLY_TO(2)
                APPLY_TO(3)
                APPLY_TO(4)
                APPLY_TO(5)
                APPLY_TO(6)
            }
#undef APPLY_TO
            l += columns;
        }
    }
}

/* Buffer that collects rows into blocks before they update an R factor; n_rows rows are filled. */
typedef struct {
    double *r;
    Lanes *block;
    Size columns, n_rows;
} RowBuffer;

/* Update the R factor with the collected rows and empty the buffer. */
static void flush_rows(RowBuffer *f)
{
    if (!f->n_rows)
        return;
    const Size padded = (f->n_rows + 2 * LANES - 1) / (2 * LANES) * 2 * LANES;
    double *block = (double *)f->block;
    /* Columns are BLOCK_ROWS apart in the buffer; `update_r_factor` needs them adjacent and padded with
       zeros. */
    for (Size j = 0; j < f->columns; j++) {
        memmove(block + j * padded, block + j * BLOCK_ROWS, f->n_rows * sizeof(double));
        memset(block + j * padded + f->n_rows, 0, (padded - f->n_rows) * sizeof(double));
    }
    update_r_factor(f->r, f->block, f->columns, padded / LANES);
    f->n_rows = 0;
}

/* Append n rows whose columns are BLOCK_ROWS apart; update the R factor whenever the buffer is full. */
static void append_rows(RowBuffer *f, const double *rows, Size n)
{
    for (Size done = 0; done < n;) {
        const Size count = n - done < BLOCK_ROWS - f->n_rows ? n - done : BLOCK_ROWS - f->n_rows;
        for (Size j = 0; j < f->columns; j++)
            memcpy((double *)f->block + j * BLOCK_ROWS + f->n_rows, rows + j * BLOCK_ROWS + done,
                   count * sizeof(double));
        f->n_rows += count, done += count;
        if (f->n_rows == BLOCK_ROWS)
            flush_rows(f);
    }
}

/* Columns that are not zero in the rows of each of k residuals.

   counts (k): number of these columns. columns (k, c): their indices. positions (k, c): position of each
   column in that list, or -1. same_columns_as (k): first residual with an equal list. All are in one
   allocation, which `counts` points to. */
typedef struct {
    Size *counts, *columns, *positions, *same_columns_as;
} NonzeroColumns;

/* Fill `nonzero`; return 0 if memory is exhausted. */
static int find_nonzero_columns(NonzeroColumns *nonzero, const ErrorTwists *e, const ObservationMatrix *h,
                                const double *given, Size c, Size k, Size m, Size column, Size residual)
{
    nonzero->counts = calloc(2 * k * (c + 1) + 1, sizeof(Size));
    if (!nonzero->counts)
        return 0;
    nonzero->same_columns_as = nonzero->counts + k, nonzero->columns = nonzero->same_columns_as + k,
    nonzero->positions = nonzero->columns + k * c;
    /* If the rows of all residuals fit into one block, one update takes less time than one per residual. */
    const int is_small = k * m <= BLOCK_ROWS;
    for (Size i = 0; i < k; i++) {
        Size *columns = nonzero->columns + i * c, *positions = nonzero->positions + i * c, u = 0;
        const Sensitivity sensitivity = row_sensitivity(h, i);
        const int has_terms = sensitivity.linear || sensitivity.angular;
        for (Size j = 0; j < c; j++) {
            const double *rows = given + (j - e->count) * column + i * residual;
            const int is_nonzero = j < e->count ? (is_small ? has_terms : is_observed(e, j, sensitivity))
                                                : is_small || !is_zero(rows, m);
            positions[j] = is_nonzero ? u : -1;
            if (is_nonzero)
                columns[u++] = j;
        }
        nonzero->counts[i] = u;
        Size first = 0;
        while (nonzero->counts[first] != u || memcmp(nonzero->columns + first * c, columns, u * sizeof(Size)))
            first++;
        nonzero->same_columns_as[i] = first;
    }
    return 1;
}

/* Return the first address in `work` that is aligned to 64 bytes. */
static double *align_to_lanes(double *work)
{
    return work + (64 - (uintptr_t)work % 64) % 64 / sizeof(double);
}

/* Number of doubles of work memory for c columns, k residuals and n_ends configurations per sample.

   The parts are: k blocks of c columns and one row buffer, velocities and lever arms, k R factors, alignment.
   */
static Size work_size(Size c, Size k, Size n_ends)
{
    return (k + 1) * c * BLOCK_ROWS + 9 * n_ends * BLOCK_ROWS + k * c * c + 8;
}

/* Compute the R factor r (c, c) of k·m rows; return 0 if memory is exhausted.

   The first e->count columns are Jacobian columns of errors, the others are `given` (c - e->count, k, m) with
   the strides `column` and `residual`. Residuals with equal nonzero columns are reduced together without
   their zero columns, and their R factors are merged at the end. Half the errors of a robot are translations,
   which do not affect orientation residuals; skipping these columns saves three quarters of the work for such
   rows. */
static int factor_rows(const ErrorTwists *e, const ObservationMatrix *h, const double *given, Size c, Size k,
                       Size m, Size column, Size residual, double *r, double *work)
{
    NonzeroColumns nonzero;
    if (!find_nonzero_columns(&nonzero, e, h, given, c, k, m, column, residual))
        return 0;
    double *blocks = align_to_lanes(work);
    Lanes *buffer = (Lanes *)(blocks + k * c * BLOCK_ROWS);
    double *velocities = (double *)buffer + c * BLOCK_ROWS;
    double *partial_r = velocities + 9 * e->n_ends * BLOCK_ROWS;
    memset(r, 0, c * c * sizeof(double));
    for (Size i = 0; i < k; i++)
        if (nonzero.same_columns_as[i] == i && nonzero.counts[i] < c)
            memset(partial_r + i * c * c, 0, nonzero.counts[i] * nonzero.counts[i] * sizeof(double));
    for (Size start = 0; start < m; start += BLOCK_ROWS) {
        const Size n = m - start < BLOCK_ROWS ? m - start : BLOCK_ROWS;
        observed_error_rows(e, h, start, n, c, nonzero.positions, velocities, blocks);
        for (Size i = 0; i < k; i++) {
            const Size u = nonzero.counts[i];
            if (nonzero.same_columns_as[i] != i || !u)
                continue;
            RowBuffer group = {u == c ? r : partial_r + i * c * c, buffer, u, 0};
            for (Size l = i; l < k; l++) {
                if (nonzero.same_columns_as[l] != i)
                    continue;
                double *block = blocks + l * c * BLOCK_ROWS;
                for (Size j = u; j-- && nonzero.columns[i * c + j] >= e->count;)
                    memcpy(block + j * BLOCK_ROWS,
                           given + (nonzero.columns[i * c + j] - e->count) * column + l * residual + start,
                           n * sizeof(double));
                if (n == BLOCK_ROWS)
                    update_r_factor(group.r, (Lanes *)block, u, BLOCK_ROWS / LANES);
                else
                    append_rows(&group, block, n);
            }
            flush_rows(&group);
        }
    }
    /* Merge the partial R factors into r, expanded to all columns. */
    RowBuffer all = {r, buffer, c, 0};
    for (Size i = 0; i < k; i++) {
        const Size u = nonzero.counts[i];
        if (nonzero.same_columns_as[i] != i || u == c)
            continue;
        for (Size row = 0; row < u; row++) {
            double *to = (double *)buffer + all.n_rows;
            for (Size j = 0; j < c; j++) {
                const Size position = nonzero.positions[i * c + j];
                to[j * BLOCK_ROWS] = position < row ? 0 : partial_r[i * c * c + row * u + position];
            }
            if (++all.n_rows == BLOCK_ROWS)
                flush_rows(&all);
        }
        flush_rows(&all);
    }
    free(nonzero.counts);
    return 1;
}

/* Compute the R factor r (p + 1, p + 1) of [r_in; diag(diagonal) | target], for example priors below data. */
static void append_diagonal(const double *r_in, Size p, const double *diagonal, const double *target,
                            double *r, double *work)
{
    const Size c = p + 1;
    double *block = align_to_lanes(work);
    memcpy(r, r_in, c * c * sizeof(double));
    for (Size start = 0; start < p; start += BLOCK_ROWS) {
        const Size n = p - start < BLOCK_ROWS ? p - start : BLOCK_ROWS;
        const Size rows = (n + 2 * LANES - 1) / (2 * LANES) * 2 * LANES;
        memset(block, 0, c * rows * sizeof(double));
        for (Size i = 0; i < n; i++) {
            block[(start + i) * rows + i] = diagonal[start + i];
            block[p * rows + i] = target[start + i];
        }
        update_r_factor(r, (Lanes *)block, c, rows / LANES);
    }
}

/* Compute the inverse (p, p) of R, whose rows are `row` apart; return its reciprocal condition number in the
   1-norm, or 0 if an element of the diagonal is 0 or one of either matrix is not finite. */
SIMD_CLONES static double invert_triangular(const double *r, Size row, Size p, double *inverse)
{
    double norm = 0, inverse_norm = 0, total = 0;
    memset(inverse, 0, p * p * sizeof(double));
    for (Size i = p; i--;) {
        double *restrict to = inverse + i * p;
        const double pivot = r[i * row + i];
        if (pivot == 0)
            return 0;
        to[i] = 1;
        for (Size j = i + 1; j < p; j++) {
            const double f = r[i * row + j], *restrict from = inverse + j * p;
            VECTORIZE (t, p - j)
                to[j + t] -= f * from[j + t];
        }
        VECTORIZE (t, p - i)
            to[i + t] /= pivot;
    }
    for (Size j = 0; j < p; j++) {
        double sum = 0, inverse_sum = 0;
        for (Size i = 0; i <= j; i++)
            sum += fabs(r[i * row + j]), inverse_sum += fabs(inverse[i * p + j]);
        norm = sum > norm ? sum : norm;
        inverse_norm = inverse_sum > inverse_norm ? inverse_sum : inverse_norm;
        total += sum + inverse_sum;
    }
    return total < INFINITY ? 1 / (norm * inverse_norm) : 0;
}

/* Solve R·x = y by back substitution for s right-hand sides y (p, s); rows of r are `row` apart. */
SIMD_CLONES static void solve_triangular(const double *r, Size row, Size p, Size s, const double *y, double *x)
{
    for (Size i = p; i--;) {
        double *restrict to = x + i * s;
        memcpy(to, y + i * s, s * sizeof(double));
        for (Size j = i + 1; j < p; j++) {
            const double f = r[i * row + j], *restrict from = x + j * s;
            VECTORIZE (t, s)
                to[t] -= f * from[t];
        }
        const double pivot = r[i * row + i];
        VECTORIZE (t, s)
            to[t] /= pivot;
    }
}
