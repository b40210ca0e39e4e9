/* Kinematics and rotations over many samples at once. */

#include <math.h>
#include <string.h>

/* One build serves every processor: where it has AVX2, that is used, and fused products where the compiler
   knows of processors that have both. */
#if !defined(__x86_64__) || !defined(__ELF__) || !defined(__GLIBC__)
    #define WIDEST
#elif defined(__clang__) || __GNUC__ >= 12
    #define WIDEST __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
    #define WIDEST __attribute__((target_clones("avx2", "default")))
#endif

/* A loop whose rounds do not touch each other's data. */
#if defined(__clang__)
    #define EACH(t, n) _Pragma("clang loop vectorize(assume_safety)") for (Size t = 0; t < (n); t++)
#else
    #define EACH(t, n) _Pragma("GCC ivdep") for (Size t = 0; t < (n); t++)
#endif

typedef Py_ssize_t Size;
/* As wide as the widest registers; narrower ones take two or four for it. */
typedef double Lanes __attribute__((vector_size(32), may_alias));
enum { LANES = 4, SAMPLES = 64, ROWS = 128 };

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
                    EACH (t, n) {
                        x1[t] = l[0] * x[t] + l[4] * y[t] + l[8] * z[t];
                        y1[t] = l[1] * x[t] + l[5] * y[t] + l[9] * z[t];
                        z1[t] = l[2] * x[t] + l[6] * y[t] + l[10] * z[t];
                        p1[t] = l[3] * x[t] + l[7] * y[t] + l[11] * z[t] + p[t];
                    }
                else if (prismatic[j])
                    EACH (t, n) {
                        const double along = l[2] * x[t] + l[6] * y[t] + l[10] * z[t];
                        x1[t] = l[0] * x[t] + l[4] * y[t] + l[8] * z[t];
                        y1[t] = l[1] * x[t] + l[5] * y[t] + l[9] * z[t];
                        z1[t] = along;
                        p1[t] = l[3] * x[t] + l[7] * y[t] + l[11] * z[t] + p[t] + q[t] * along;
                    }
                else
                    EACH (t, n) {
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

WIDEST static void velocities(Size p, Size m, const double *frames, Size body, Size row, const double *point,
                              Size point_row, const Size *at, const double *twist, double *out,
                              Size out_twist, Size out_row)
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
                EACH (t, n)
                    v[t] += wy[t] * lever[z][t] - wz[t] * lever[y][t];
            }
        }
    }
}

/* Vectors of c components mixed by a matrix (k, c) that every sample has its own of. */
WIDEST static void mix(Size p, Size k, Size c, Size m, const double *vectors, Size vector, Size component,
                       const double *matrices, Size row, Size column, double *out, Size out_vector,
                       Size out_row)
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
                    EACH (t, n)
                        to[t] = f[t] * v[t] + f[column + t] * v[component + t] +
                                f[2 * column + t] * v[2 * component + t];
                for (; l < c; l++)
                    EACH (t, n)
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

/* Rotation vectors (3, m) of matrices (3, 3, m); how many angles are so obtuse that they take more care. */
WIDEST static Size rotation_vectors(Size m, const double *turns, Size row, Size column, double *out,
                                    Size axis)
{
    Size obtuse = 0;
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        double sine[SAMPLES], cosine[SAMPLES];
        const double *r = turns + start;
        double *v = out + start;
        EACH (t, n) {
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
WIDEST static void jacobian_inverses(Size m, const double *vectors, Size axis, double *out, Size row,
                                     Size column)
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
        EACH (t, n) {
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
