/* Jacobian of a point by kinematic errors, and the rows of measurements that follow from it.

   A unit error of twist [v, ω] in the axes of body b, with rotation R and origin o at one sample, moves a
   point p by

       angular velocity   ω' = R·ω,
       linear velocity    v' = R·v + ω' × (p - o),          p - o is the lever arm.

   A sample is observed at one or two configurations ("ends"; two for relative measurements). With the
   velocities y = [v', ω'] (6 components per end) the Jacobian row of residual k at sample t is

       J[k, t] = Σ_q coefficient[q, t]·y[component[q]]       over the terms q with row[q] = k,

   a sparse product by the whitened observation matrix H of the measurement. Strides count doubles. */

/* Rotate a vector given in body axes to the base axes, at n samples; zero components are skipped. */
static inline __attribute__((always_inline)) void rotate_to_base(double *restrict out, const double *axes,
                                                                 Size row, const double *vector, Size n)
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
        VECTORIZE (t, n)
            out[t] = f * x[t];
    } else if (count == 2) {
        const double f = vector[given[0]], g = vector[given[1]];
        VECTORIZE (t, n)
            out[t] = f * x[t] + g * y[t];
    } else {
        const double f = vector[0], g = vector[1], h = vector[2];
        VECTORIZE (t, n)
            out[t] = f * x[t] + g * y[t] + h * z[t];
    }
}

/* Compute the vector from a body's origin to the point in base axes (3, BLOCK_ROWS), at n samples. */
static inline __attribute__((always_inline)) void
lever_arm(double *lever, const double *point, Size point_row, const double *frame, Size row, Size n)
{
    for (Size i = 0; i < 3; i++) {
        const double *restrict p = point + i * point_row, *restrict o = frame + (9 + i) * row;
        double *restrict to = lever + i * BLOCK_ROWS;
        VECTORIZE (t, n)
            to[t] = p[t] - o[t];
    }
}

static inline __attribute__((always_inline)) int has_rotation(const double *twist)
{
    return twist[3] != 0 || twist[4] != 0 || twist[5] != 0;
}

/* Compute the velocity [v', ω'] (6, n) of the point by a unit twist of a body. */
static inline __attribute__((always_inline)) void point_velocity(double *out, Size out_row,
                                                                 const double *frame, Size row,
                                                                 const double *twist, const double *lever,
                                                                 Size n)
{
    for (Size i = 0; i < 3; i++)
        rotate_to_base(out + (3 + i) * out_row, frame + i * row, row, twist + 3, n);
    for (Size i = 0; i < 3; i++)
        rotate_to_base(out + i * out_row, frame + i * row, row, twist, n);
    if (has_rotation(twist))
        for (Size i = 0; i < 3; i++) {
            const Size y = (i + 1) % 3, z = (i + 2) % 3;
            const double *restrict wy = out + (3 + y) * out_row, *restrict wz = out + (3 + z) * out_row;
            const double *restrict ly = lever + y * BLOCK_ROWS, *restrict lz = lever + z * BLOCK_ROWS;
            double *restrict v = out + i * out_row;
            VECTORIZE (t, n)
                v[t] += wy[t] * lz[t] - wz[t] * ly[t];
        }
}

/* Twists of kinematic errors (count), sorted by body, with the frames and the point that they act on.

   The samples of end e start at e·end_offset. */
typedef struct {
    Size count, n_ends, end_offset;
    const Size *bodies;
    const double *twists, *frames, *point;
    Size frame_stride, row_stride, point_stride;
} ErrorTwists;

/* Compute the Jacobian (count, 6, m) of the point by all errors. */
SIMD_CLONES static void point_jacobian(const ErrorTwists *e, Size m, double *out, Size out_twist,
                                       Size out_row)
{
    double lever[3 * BLOCK_ROWS];
    for (Size start = 0; start < m; start += BLOCK_ROWS) {
        const Size n = m - start < BLOCK_ROWS ? m - start : BLOCK_ROWS;
        for (Size j = 0; j < e->count; j++) {
            const double *frame = e->frames + e->bodies[j] * e->frame_stride + start;
            if (!j || e->bodies[j] != e->bodies[j - 1])
                lever_arm(lever, e->point + start, e->point_stride, frame, e->row_stride, n);
            point_velocity(out + j * out_twist + start, out_row, frame, e->row_stride, e->twists + 6 * j,
                           lever, n);
        }
    }
}

/* Sparse observation matrix H of m samples with `count` terms, sorted by row.

   Term q adds coefficients[q, t] times component components[q] of the velocity to row rows[q]. Components 0
   ... 5 are vx, vy, vz, ωx, ωy, ωz at the first end, 6 ... 11 at the second. */
typedef struct {
    Size count;
    const Size *rows, *components;
    const double *coefficients;
    Size stride;
} ObservationMatrix;

/* Whether a row depends on linear and on angular velocities. */
typedef struct {
    int linear, angular;
} Sensitivity;

static Sensitivity row_sensitivity(const ObservationMatrix *h, Size row)
{
    Sensitivity out = {0, 0};
    for (Size q = 0; q < h->count; q++)
        if (h->rows[q] == row)
            *(h->components[q] % 6 < 3 ? &out.linear : &out.angular) = 1;
    return out;
}

/* Whether a row with this sensitivity can depend on an error; a rotation moves the point, too. */
static int is_observed(const ErrorTwists *e, Size error, Sensitivity row)
{
    const double *twist = e->twists + 6 * error;
    if (has_rotation(twist))
        return row.linear || row.angular;
    return row.linear && (twist[0] != 0 || twist[1] != 0 || twist[2] != 0);
}

/* Compute one row of H·velocity at n samples, starting with term q; return the first term of the next row.

   `component` and `end` are strides of the velocity. Angular terms are skipped unless the error rotates. Up
   to three terms are added in one pass. */
static inline __attribute__((always_inline)) Size observation_row(double *restrict out,
                                                                  const ObservationMatrix *h, Size q,
                                                                  const double *velocity, Size component,
                                                                  Size end, int rotates, Size start, Size n)
{
    const Size row = h->rows[q];
    int has_value = 0;
    while (q < h->count && h->rows[q] == row) {
        const double *f[3] = {0}, *v[3] = {0};
        int n_terms = 0;
        for (; q < h->count && h->rows[q] == row && n_terms < 3; q++) {
            const Size axis = h->components[q] % 6;
            if (axis > 2 && !rotates)
                continue;
            f[n_terms] = h->coefficients + q * h->stride + start;
            v[n_terms++] = velocity + axis * component + h->components[q] / 6 * end;
        }
        const double *restrict f0 = f[0], *restrict f1 = f[1], *restrict f2 = f[2];
        const double *restrict v0 = v[0], *restrict v1 = v[1], *restrict v2 = v[2];
        if (n_terms == 3 && has_value)
            VECTORIZE (t, n)
                out[t] += f0[t] * v0[t] + f1[t] * v1[t] + f2[t] * v2[t];
        else if (n_terms == 3)
            VECTORIZE (t, n)
                out[t] = f0[t] * v0[t] + f1[t] * v1[t] + f2[t] * v2[t];
        else if (n_terms == 1 && !has_value)
            VECTORIZE (t, n)
                out[t] = f0[t] * v0[t];
        else {
            if (!has_value)
                memset(out, 0, n * sizeof(double));
            for (int i = 0; i < n_terms; i++) {
                const double *restrict fi = f[i], *restrict vi = v[i];
                VECTORIZE (t, n)
                    out[t] += fi[t] * vi[t];
            }
        }
        has_value = 1;
    }
    return q;
}

/* Compute the rows (p, k, m) of H times the Jacobian (p, 6, ends·m). */
SIMD_CLONES static void apply_observation_matrix(const ObservationMatrix *h, Size p, Size k, Size m,
                                                 const double *jacobian, Size velocity, Size component,
                                                 double *out, Size out_error, Size out_row)
{
    for (Size start = 0; start < m; start += BLOCK_ROWS) {
        const Size n = m - start < BLOCK_ROWS ? m - start : BLOCK_ROWS;
        for (Size j = 0; j < p; j++)
            for (Size i = 0, q = 0; i < k; i++) {
                double *to = out + j * out_error + i * out_row + start;
                if (q < h->count && h->rows[q] == i)
                    q = observation_row(to, h, q, jacobian + j * velocity + start, component, m, 1, start, n);
                else
                    memset(to, 0, n * sizeof(double));
            }
    }
}

/* Compute the whitened Jacobian rows of n samples into blocks (k, c, BLOCK_ROWS), one block per residual.

   positions (k, c) gives the column of each error in the block of each residual, or -1. `velocities` is work
   memory for 9·n_ends·BLOCK_ROWS doubles: the velocities (6) and lever arms (3) of all ends. */
SIMD_CLONES static void observed_error_rows(const ErrorTwists *e, const ObservationMatrix *h, Size start,
                                            Size n, Size c, const Size *positions, double *velocities,
                                            double *blocks)
{
    double *levers = velocities + 6 * e->n_ends * BLOCK_ROWS;
    for (Size j = 0; j < e->count; j++) {
        const double *twist = e->twists + 6 * j;
        for (Size end = 0; end < e->n_ends; end++) {
            const double *frame = e->frames + e->bodies[j] * e->frame_stride + end * e->end_offset + start;
            double *lever = levers + 3 * end * BLOCK_ROWS;
            if (!j || e->bodies[j] != e->bodies[j - 1])
                lever_arm(lever, e->point + end * e->end_offset + start, e->point_stride, frame,
                          e->row_stride, n);
            point_velocity(velocities + 6 * end * BLOCK_ROWS, BLOCK_ROWS, frame, e->row_stride, twist, lever,
                           n);
        }
        for (Size q = 0; q < h->count;) {
            const Size row = h->rows[q], position = positions[row * c + j];
            if (position >= 0)
                q = observation_row(blocks + (row * c + position) * BLOCK_ROWS, h, q, velocities, BLOCK_ROWS,
                                    6 * BLOCK_ROWS, has_rotation(twist), start, n);
            else
                while (q < h->count && h->rows[q] == row)
                    q++;
        }
    }
}
