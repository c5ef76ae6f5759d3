/* Many machines at once, the same equations as malta's and the very same noise: W to a vector, OpenMP over the rest. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined __AVX512F__
#define W 8
#define MVEC(name) _ZGVeN8v_##name
#elif defined __AVX2__
#define W 4
#define MVEC(name) _ZGVdN4v_##name
#else
#define W 2
#define MVEC(name) _ZGVbN2v_##name
#endif
typedef double real __attribute__((vector_size(8 * W)));
typedef int64_t mask __attribute__((vector_size(8 * W)));
typedef uint64_t words __attribute__((vector_size(8 * W)));
#define EACH for (int i = 0; i < W; i++)

real MVEC(log)(real); /* glibc's libmvec */
real MVEC(sin)(real);
real MVEC(cos)(real);

static inline real all(double x) { return x - (real){0}; }
static inline real pick(mask m, real a, real b) { return (real)((m & (mask)a) | (~m & (mask)b)); }
static inline real larger(real a, real b) { return pick(a > b, a, b); }
static inline real smaller(real a, real b) { return pick(a < b, a, b); }
static inline real clamp(real a, double limit) { return larger(smaller(a, all(limit)), all(-limit)); }
static inline real differ(real a, real b) { return (real)((a != b) & (mask)all(1)); }
static inline real magnitude(real a) { return (real)((mask)a & INT64_MAX); }
#ifdef LIBMVEC
static inline real sine(real x) { return MVEC(sin)(x); }
static inline real cosine(real x) { return MVEC(cos)(x); }
static inline real wave_sine(real x) { return MVEC(sin)(x); }
#else
/* A mover in its air gap tilts by milliradians: the series, where all lanes are as small. */
static inline int tiny(real x)
{
    mask m = x * x > 4e-4;
    int64_t any = 0;
    EACH any |= m[i];
    return __builtin_expect(!any, 1);
}
static inline real sine(real x)
{
    real z = x * x;
    return tiny(x) ? x + x * z * (-1. / 6 + z * (1. / 120 + z * (-1. / 5040))) : MVEC(sin)(x);
}
static inline real cosine(real x)
{
    real z = x * x;
    return tiny(x) ? 1 + z * (-1. / 2 + z * (1. / 24 + z * (-1. / 720))) : MVEC(cos)(x);
}
/* Between the zeros an odd polynomial, the sign by the zero's parity. */
static inline real wave_sine(real x)
{
    const double shift = 0x1.8p52;
    real u = x * 0.318309886183790672, counted = u + shift, r = u - (counted - shift), t = r * r;
    real s = 3.1415926535897927 + t * (-5.167712780049786 + t * (2.550164039861884 + t * (-0.5992645288256148
        + t * (0.08214587882077493 + t * (-0.007370364352718201 + t * (0.0004659870919775173
        + t * -2.1133714397960184e-05))))));
    return (real)((mask)(r * s) ^ ((mask)counted << 63));
}
#endif
#include "plain.h"

/* Two normals by Box and Muller from SplitMix64 of a key and a counter, in single precision: malta/simulation/readings.py.
 * To the bit, so nothing is contracted. */
typedef uint32_t halves __attribute__((vector_size(4 * W)));
typedef int32_t indices __attribute__((vector_size(4 * W)));
typedef float singles __attribute__((vector_size(4 * W)));
static __attribute__((noinline, optimize("fp-contract=off"))) void normals(words key, uint64_t count, real *a, real *b)
{
    words x = key + count * 0x9e3779b97f4a7c15;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9;
    x = (x ^ (x >> 27)) * 0x94d049bb133111eb;
    x ^= x >> 31;
    halves high = __builtin_convertvector(x >> 32, halves), low = __builtin_convertvector(x, halves);
    halves bits = (halves)__builtin_convertvector(high | 1, singles);
    indices k = (indices)(bits - 0x3f3504f3u) >> 23;
    singles f = (singles)(bits - ((halves)k << 23)) - 1;
    singles log_u = f * (0.99999992f + f * (-0.50000344f + f * (0.33335607f + f * (-0.24971558f + f * (0.19884252f
        + f * (-0.17212471f + f * (0.16338027f + f * -0.10378417f)))))))
        + 0.69314718f * __builtin_convertvector(k - 32, singles);
    singles radius = -2 * log_u;
    EACH radius[i] = sqrtf(radius[i]);
    singles turn = __builtin_convertvector((indices)((low << 1) ^ 0x80000000u), singles) * 0x1p-32f, t = turn * turn;
    radius = (singles)((halves)radius ^ (low & 0x80000000u));
    singles s = turn * (3.14159264f + t * (-5.1677101f + t * (2.5500775f + t * (-0.59829129f + t * 0.07765766f))));
    singles c = 0.99999995f + t * (-4.93479283f + t * (4.05841135f + t * (-1.33187657f + t * 0.21968961f)));
    *a = __builtin_convertvector(radius * c, real), *b = __builtin_convertvector(radius * s, real);
}

static inline void look_up(long points, const double *grid, real z, real *v0)
{
    double per_metre = (points - 1) / (grid[11 * (points - 1)] - grid[0]); /* the grid is even */
    z = larger(smaller(z, all(grid[11 * (points - 1)])), all(grid[0]));
    real u = (z - grid[0]) * per_metre;
    mask k = __builtin_convertvector(smaller(u, all(points - 2)), mask);
    EACH for (int j = 0; j < 5; j++) v0[j][i] = grid[11 * k[i] + 1 + j] + (z[i] - grid[11 * k[i]]) * grid[11 * k[i] + 6 + j];
}

/* machines: sizeof(Machine) / sizeof(real) rows of `count`, a multiple of W; states: 37 such rows: the mover's, forces,
 * xi, e, frozen. largest: five. Errors count up to and with the sample of a touchdown. */
static void group(const double *machine, const Law *law, long points, const double *grid, long count, long samples,
                  long substeps, const double *p_ref, const double *xi_ref, const double *v_ff, const double *states,
                  const uint64_t *keys, const double *sigma, double *largest, uint8_t *touched)
{
    union { Machine c; real rows[sizeof(Machine) / sizeof(real)]; } m;
    real s[12], f[5], xi[10], e[5], frozen[5], most[5] = {{0}}, noise[10];
    words key;
    mask flying = s[0] == s[0];
    flying |= ~flying;
    memcpy(&key, keys, sizeof key);
    for (unsigned j = 0; j < sizeof m / sizeof(real); j++) memcpy(m.rows + j, machine + j * count, sizeof(real));
    for (int j = 0; j < 12; j++) memcpy(s + j, states + j * count, sizeof(real));
    for (int j = 0; j < 5; j++) memcpy(f + j, states + (12 + j) * count, sizeof(real));
    for (int j = 0; j < 10; j++) memcpy(xi + j, states + (17 + j) * count, sizeof(real));
    for (int j = 0; j < 5; j++) e[j] = frozen[j] = all(0);
    for (long k = 0; k < samples; k++, p_ref += 5, xi_ref += 10, v_ff += 5) {
        real y[5], v0[5], v[5];
        measure(&m.c, s, y);
        for (int j = 0; j < 5; j++) most[j] = larger(most[j], (real)((mask)magnitude(y[j] - p_ref[j]) & flying));
        flying &= (y[0] * y[0] + y[1] * y[1] < m.c.r_max2) & (y[2] * y[2] + y[3] * y[3] < m.c.r_max2);
        flying &= magnitude(y[4]) < m.c.z_max;
        if (k % 2 == 0) for (int j = 0; j < 5; j++) normals(key, (uint64_t)(k / 2 * 5 + j), noise + 2 * j, noise + 2 * j + 1);
        for (int j = 0; j < 5; j++) y[j] += sigma[j] * noise[k % 2 * 5 + j];
        look_up(points, grid, y[4], v0);
        decide(law, y, v0, p_ref, xi_ref, v_ff, xi, e, frozen, v);
        for (int j = 0; j < 5; j++) v[j] *= j < 4 ? m.c.gain_B : m.c.gain_D;
        advance(&m.c, substeps, v, s, f);
    }
    for (int j = 0; j < 5; j++) memcpy(largest + j * count, most + j, sizeof(real));
    EACH touched[i] = !flying[i];
}

int width(void) { return W; }

void many(const double *machines, const Law *law, long points, const double *grid, long count, long samples,
          long substeps, const double *p_ref, const double *xi_ref, const double *v_ff, const double *states,
          const uint64_t *keys, const double *sigma, double *largest, uint8_t *touched)
{
#pragma omp parallel for schedule(dynamic)
    for (long i = 0; i < count; i += W)
        group(machines + i, law, points, grid, count, samples, substeps, p_ref, xi_ref, v_ff, states + i, keys + i, sigma,
              largest + i, touched + i);
}
