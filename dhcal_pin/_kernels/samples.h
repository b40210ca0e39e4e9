/* Sine, cosine, chain frames and rotation vectors of many samples.

   Sine and cosine. Cody-Waite reduction: n = round(2·angle/π) and r = angle - n·π/2 with π/2 as a sum of
   three doubles, so that |r| <= π/4. With u = r² the Taylor polynomials are

       sin r = r·(1 - u/3! + u²/5! - ... - u⁷/15!)    degree 15, truncation error 6.5e-17 relative,
       cos r = 1 - u/2! + u²/4! - ... + u⁸/16!        degree 16, truncation error 2.9e-18 relative,

   and n mod 4 selects the function and its sign. Angles of |angle| >= 1e5 rad use the C library.

   Arc tangent. atan x = x·(1 - x²/3 + x⁴/5 - ... + x¹²/13), degree 13, for x² < 4e-3: truncation error
   1.1e-18 relative. Larger angles use atan2 of the C library.

   Measured largest relative errors of 4 million random angles per range, against 80-bit long double: sine and
   cosine 2.2e-16 for |angle| <= π/4, 2.7e-16 for |angle| <= π and 3.8e-16 for |angle| < 1e5 rad, with and
   without fused multiply-add; the arc tangent polynomial 0.6e-16. 20,000 angles of each range against mpmath
   with 50 digits gave no larger error. The results do not depend on the version of the C library.

   Frames. F_{j+1} = F_j·L_j·M_j(q_j) along the chain: L_j is the constant link transform and M_j a rotation
   about z by q_j or a translation along z by q_j; the last link has no motion. A frame is stored as its
   columns x, y, z, p (4, 3, m).

   Logarithm and right Jacobian of SO(3). With w = (R32 - R23, R13 - R31, R21 - R12) = 2·sin θ·axis and
   c = trace R - 1 = 2·cos θ: log R = w·atan(|w|/c)/|w|.
   Jr⁻¹(φ) = I + ½[φ]× + f·[φ]×² with θ = |φ| and f = 1/θ² - 1/(2θ·tan(θ/2)); for θ² < 1e-3 the series
   f = 1/12 + θ²/720 + θ⁴/30240. */

#include <math.h>
#include <stdint.h>
#include <string.h>

/* Compile a function for several instruction sets; the loader selects the best one of the processor. The
   level x86-64-v3 has AVX2 and fused multiply-add. */
#if !defined(__x86_64__) || !defined(__ELF__) || !defined(__GLIBC__)
    #define SIMD_CLONES
#elif defined(__clang__) || __GNUC__ >= 12
    #define SIMD_CLONES __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
    #define SIMD_CLONES __attribute__((target_clones("avx2", "default")))
#endif

/* Loop over t = 0 ... n-1 whose iterations are independent, so that the compiler can vectorize it. */
#if defined(__clang__)
    #define VECTORIZE(t, n) _Pragma("clang loop vectorize(assume_safety)") for (Size t = 0; t < (n); t++)
#else
    #define VECTORIZE(t, n) _Pragma("GCC ivdep") for (Size t = 0; t < (n); t++)
#endif

typedef Py_ssize_t Size;
typedef uint64_t Bits __attribute__((may_alias));
/* Four doubles, one AVX register; processors with narrower registers use two or four of them. */
typedef double Lanes __attribute__((vector_size(32), may_alias));
/* LANES: doubles in `Lanes`. BLOCK_SAMPLES: samples that the functions of this file treat together.
   BLOCK_ROWS: rows of a block that is reduced by Householder reflectors. MAX_COLUMNS: columns that a pair of
   reflectors is applied to at once. Blocks of 20 columns fit into the first-level cache. */
enum { LANES = 4, BLOCK_SAMPLES = 64, BLOCK_ROWS = 192, MAX_COLUMNS = 6 };

/* Evaluate a polynomial by Horner's rule; `count` coefficients, highest degree first. */
static inline __attribute__((always_inline)) double polynomial(double u, const double *coefficients,
                                                               const int count)
{
    double out = coefficients[0];
    for (int i = 1; i < count; i++)
        out = out * u + coefficients[i];
    return out;
}

/* Coefficients of sin(x)/x, cos(x) and atan(x)/x as polynomials of x². */
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
/* Largest x² for the arc tangent polynomial. */
#define ARCTAN_LIMIT 4e-3
/* π/2 as a sum of three parts. The first two have trailing zero bits, so that their products with n are exact
   for all angles below REDUCTION_LIMIT [rad]. */
static const double half_pi[] = {1.57079632673412561417, 6.07710050630396597660e-11,
                                 2.02226624879595063154e-21};
#define REDUCTION_LIMIT 1e5
/* 1.5·2⁵²: after adding it, the lowest bits of the sum are the nearest integer (two's complement). */
#define ROUND_TO_INTEGER 0x1.8p52

/* Compute cosines and sines of m angles [rad]. */
SIMD_CLONES static void sincos_batch(Size m, const double *restrict angle, double *restrict cosine,
                                     double *restrict sine)
{
    VECTORIZE (t, m) {
        const double rounded = angle[t] * (2 / M_PI) + ROUND_TO_INTEGER, n = rounded - ROUND_TO_INTEGER;
        const double r = angle[t] - n * half_pi[0] - n * half_pi[1] - n * half_pi[2], u = r * r;
        const double s = r * polynomial(u, sine_series, 8), c = polynomial(u, cosine_series, 9);
        Bits quadrant;
        memcpy(&quadrant, &rounded, sizeof quadrant);
        const double cos_size = quadrant & 1 ? s : c, sin_size = quadrant & 1 ? c : s;
        cosine[t] = (quadrant + 1) & 2 ? -cos_size : cos_size;
        sine[t] = quadrant & 2 ? -sin_size : sin_size;
    }
    for (Size t = 0; t < m; t++)
        if (!(fabs(angle[t]) < REDUCTION_LIMIT))
            cosine[t] = cos(angle[t]), sine[t] = sin(angle[t]);
}

/* Compute the columns x, y, z, p of frames 1 ... n_links of a chain; frame 0 is given.

   link_transforms (n_links, 4, 4), prismatic (n_links - 1), joint values, cosines and sines (n_links - 1, m).
   `joint`, `body` and `row` are the strides of joints, frames and component rows. */
SIMD_CLONES static void propagate_frames(Size n_links, Size m, const double *link_transforms,
                                         const char *prismatic, const double *values, const double *cosine,
                                         const double *sine, Size joint, double *frames, Size body, Size row)
{
    for (Size start = 0; start < m; start += BLOCK_SAMPLES) {
        const Size n = m - start < BLOCK_SAMPLES ? m - start : BLOCK_SAMPLES;
        for (Size j = 0; j < n_links; j++) {
            double link[12];
            memcpy(link, link_transforms + 16 * j, sizeof link);
            const double *restrict q = values + j * joint + start;
            const double *restrict c = cosine + j * joint + start, *restrict s = sine + j * joint + start;
            for (Size i = 0; i < 3; i++) {
                const double *from = frames + j * body + i * row + start;
                const double *restrict x = from, *restrict y = from + 3 * row, *restrict z = from + 6 * row,
                                       *restrict p = from + 9 * row;
                double *to = frames + (j + 1) * body + i * row + start;
                double *restrict x1 = to, *restrict y1 = to + 3 * row, *restrict z1 = to + 6 * row,
                                 *restrict p1 = to + 9 * row;
                if (j == n_links - 1)
                    VECTORIZE (t, n) {
                        x1[t] = link[0] * x[t] + link[4] * y[t] + link[8] * z[t];
                        y1[t] = link[1] * x[t] + link[5] * y[t] + link[9] * z[t];
                        z1[t] = link[2] * x[t] + link[6] * y[t] + link[10] * z[t];
                        p1[t] = link[3] * x[t] + link[7] * y[t] + link[11] * z[t] + p[t];
                    }
                else if (prismatic[j])
                    VECTORIZE (t, n) {
                        const double along = link[2] * x[t] + link[6] * y[t] + link[10] * z[t];
                        x1[t] = link[0] * x[t] + link[4] * y[t] + link[8] * z[t];
                        y1[t] = link[1] * x[t] + link[5] * y[t] + link[9] * z[t];
                        z1[t] = along;
                        p1[t] = link[3] * x[t] + link[7] * y[t] + link[11] * z[t] + p[t] + q[t] * along;
                    }
                else
                    VECTORIZE (t, n) {
                        const double u = link[0] * x[t] + link[4] * y[t] + link[8] * z[t];
                        const double v = link[1] * x[t] + link[5] * y[t] + link[9] * z[t];
                        z1[t] = link[2] * x[t] + link[6] * y[t] + link[10] * z[t];
                        p1[t] = link[3] * x[t] + link[7] * y[t] + link[11] * z[t] + p[t];
                        x1[t] = c[t] * u + s[t] * v;
                        y1[t] = c[t] * v - s[t] * u;
                    }
            }
        }
    }
}

/* Compute rotation vectors (3, m) of rotations (3, 3, m) with strides of rows, columns and components.

   Return the number of rotations with 2·cos θ < -1.8. Near θ = π the formula loses digits, and the caller has
   to use the quaternion instead. */
SIMD_CLONES static Size log_rotations(Size m, const double *rotations, Size row, Size column, double *out,
                                      Size axis)
{
    Size n_near_half_turn = 0;
    for (Size start = 0; start < m; start += BLOCK_SAMPLES) {
        const Size n = m - start < BLOCK_SAMPLES ? m - start : BLOCK_SAMPLES;
        double sine[BLOCK_SAMPLES], cosine[BLOCK_SAMPLES], f[BLOCK_SAMPLES];
        const double *r = rotations + start;
        double *v = out + start;
        VECTORIZE (t, n) {
            const double x = r[2 * row + column + t] - r[row + 2 * column + t];
            const double y = r[2 * column + t] - r[2 * row + t];
            const double z = r[row + t] - r[column + t];
            v[t] = x, v[axis + t] = y, v[2 * axis + t] = z;
            const double s = fmax(x * x + y * y + z * z, 1e-300);
            const double c = r[t] + r[row + column + t] + r[2 * (row + column) + t] - 1, u = s / (c * c);
            sine[t] = s, cosine[t] = c;
            f[t] = polynomial(u, arctan_series, 7) / c;
        }
        for (Size t = 0; t < n; t++)
            if (!(cosine[t] > 0 && sine[t] < ARCTAN_LIMIT * cosine[t] * cosine[t])) {
                const double s = sqrt(sine[t]);
                f[t] = atan2(s, cosine[t]) / s;
                n_near_half_turn += cosine[t] < -1.8;
            }
        VECTORIZE (t, n)
            v[t] *= f[t], v[axis + t] *= f[t], v[2 * axis + t] *= f[t];
    }
    return n_near_half_turn;
}

/* Compute the inverse right Jacobians (3, 3, m) of rotation vectors (3, m). */
SIMD_CLONES static void right_jacobian_inverses(Size m, const double *vectors, Size axis, double *out,
                                                Size row, Size column)
{
    for (Size start = 0; start < m; start += BLOCK_SAMPLES) {
        const Size n = m - start < BLOCK_SAMPLES ? m - start : BLOCK_SAMPLES;
        double angle_squared[BLOCK_SAMPLES], f[BLOCK_SAMPLES];
        const double *v = vectors + start;
        double *to = out + start;
        for (Size t = 0; t < n; t++) {
            const double x = v[t], y = v[axis + t], z = v[2 * axis + t], s = x * x + y * y + z * z;
            angle_squared[t] = s;
            f[t] = 1.0 / 12 + s * (1.0 / 720 + s / 30240);
        }
        for (Size t = 0; t < n; t++)
            if (!(angle_squared[t] < 1e-3)) {
                const double angle = sqrt(angle_squared[t]);
                f[t] = 1 / angle_squared[t] - 0.5 / (angle * tan(0.5 * angle));
            }
        VECTORIZE (t, n) {
            const double x = v[t], y = v[axis + t], z = v[2 * axis + t], rest = 1 - f[t] * angle_squared[t];
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
