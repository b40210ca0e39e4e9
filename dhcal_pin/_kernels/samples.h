/* Kinematics and rotations over many samples at once. */

#include <math.h>
#include <stdint.h>
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
typedef uint64_t Bits __attribute__((may_alias));
/* As wide as the widest registers; narrower ones take two or four for it. */
typedef double Lanes __attribute__((vector_size(32), may_alias));
enum { LANES = 4, SAMPLES = 64, ROWS = 128, WIDTH = 6 };

/* A power series of `count` coefficients, the highest first. */
static inline __attribute__((always_inline)) double series(double u, const double *coefficients,
                                                           const int count)
{
    double out = coefficients[0];
    for (int i = 1; i < count; i++)
        out = out * u + coefficients[i];
    return out;
}

/* In the square of x: sine over x, cosine, both right to a quarter of a half turn, and the arc tangent over
   x, right as long as the square stays below SMALL. */
static const double sine_series[] = {-1.0 / 1307674368000, 1.0 / 6227020800, -1.0 / 39916800, 1.0 / 362880,
                                     -1.0 / 5040,          1.0 / 120,        -1.0 / 6,        1};
static const double cosine_series[] = {1.0 / 20922789888000,
                                       -1.0 / 87178291200,
                                       1.0 / 479001600,
                                       -1.0 / 3628800,
                                       1.0 / 40320,
                                       -1.0 / 720,
                                       1.0 / 24,
                                       -1.0 / 2,
                                       1};
static const double arctan_series[] = {1.0 / 13, -1.0 / 11, 1.0 / 9, -1.0 / 7, 1.0 / 5, -1.0 / 3, 1};
#define SMALL 4e-3
/* A quarter turn in three parts, the first two with zeros at their ends, so that some ten thousand of them
   are exact, and the angle from which there are more. */
static const double quarter[] = {1.57079632673412561417, 6.07710050630396597660e-11,
                                 2.02226624879595063154e-21};
#define MANY_TURNS 1e5
/* Adding this leaves a number's nearest integer in its last bits. */
#define ROUNDS 0x1.8p52

/* By the nearest quarter turn and the series of the rest. */
WIDEST static void circle(Size m, const double *restrict angle, double *restrict cosine,
                          double *restrict sine)
{
    EACH (t, m) {
        const double rounded = angle[t] * (2 / M_PI) + ROUNDS, n = rounded - ROUNDS;
        const double r = angle[t] - n * quarter[0] - n * quarter[1] - n * quarter[2], u = r * r;
        const double s = r * series(u, sine_series, 8), c = series(u, cosine_series, 9);
        Bits which;
        memcpy(&which, &rounded, sizeof which);
        const double across = which & 1 ? s : c, along = which & 1 ? c : s;
        cosine[t] = (which + 1) & 2 ? -across : across;
        sine[t] = which & 2 ? -along : along;
    }
    for (Size t = 0; t < m; t++)
        if (!(fabs(angle[t]) < MANY_TURNS))
            cosine[t] = cos(angle[t]), sine[t] = sin(angle[t]);
}

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

/* Rotation vectors (3, m) of matrices (3, 3, m); how many angles are so obtuse that they take more care. */
WIDEST static Size rotation_vectors(Size m, const double *turns, Size row, Size column, double *out,
                                    Size axis)
{
    Size obtuse = 0;
    for (Size start = 0; start < m; start += SAMPLES) {
        const Size n = m - start < SAMPLES ? m - start : SAMPLES;
        double sine[SAMPLES], cosine[SAMPLES], f[SAMPLES];
        const double *r = turns + start;
        double *v = out + start;
        EACH (t, n) {
            const double x = r[2 * row + column + t] - r[row + 2 * column + t];
            const double y = r[2 * column + t] - r[2 * row + t];
            const double z = r[row + t] - r[column + t];
            v[t] = x, v[axis + t] = y, v[2 * axis + t] = z;
            const double s = fmax(x * x + y * y + z * z, 1e-300);
            const double c = r[t] + r[row + column + t] + r[2 * (row + column) + t] - 1, u = s / (c * c);
            sine[t] = s, cosine[t] = c;
            f[t] = series(u, arctan_series, 7) / c;
        }
        for (Size t = 0; t < n; t++)
            if (!(cosine[t] > 0 && sine[t] < SMALL * cosine[t] * cosine[t])) {
                const double s = sqrt(sine[t]);
                f[t] = atan2(s, cosine[t]) / s;
                obtuse += cosine[t] < -1.8;
            }
        EACH (t, n)
            v[t] *= f[t], v[axis + t] *= f[t], v[2 * axis + t] *= f[t];
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
