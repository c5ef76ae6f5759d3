/* The loop around one control period of machine and controller: the frame of every compiled engine.

   The functions `prepare`, `sense`, `decide`, `substep` and `digest` are generated from the CasADi expressions of
   period.py and stand at the mark below; the sizes are #defines before it. LANES machines run side by side, one in
   each lane of a SIMD register; with LANES 1 a `real` is a double and the rows of every sample are kept.           */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if LANES > 1 && defined(__AVX512DQ__)
#include <immintrin.h>
#endif

#if LANES == 1
typedef double real;
typedef int64_t whole; /* as a truth: -1 or 0 */
#define LANE(x, i) (x)
static inline whole bits(real x) { whole b; memcpy(&b, &x, 8); return b; }
static inline real value(whole b) { real x; memcpy(&x, &b, 8); return x; }
#define MASK(m) (-(whole)(m))
static inline real pick(whole m, real a, real b) { return m ? a : b; }
#else
typedef double real __attribute__((vector_size(8 * LANES)));
typedef int64_t whole __attribute__((vector_size(8 * LANES)));
#define LANE(x, i) ((x)[i])
static inline whole bits(real x) { return (whole)x; }
static inline real value(whole b) { return (real)b; }
#define MASK(m) ((whole)(m))
static inline real pick(whole m, real a, real b) { return value((m & bits(a)) | (~m & bits(b))); }
#endif
static inline real truth(whole m) { return value(m & bits((real){0} + 1.0)); }
static inline real where(whole m, real x) { return value(m & bits(x)); }
#if LANES == 8 && defined(__AVX512DQ__)
static inline real larger(real a, real b) { return (real)_mm512_max_pd((__m512d)a, (__m512d)b); }
static inline real smaller(real a, real b) { return (real)_mm512_min_pd((__m512d)a, (__m512d)b); }
#else
static inline real larger(real a, real b) { return pick(MASK(a > b), a, b); }
static inline real smaller(real a, real b) { return pick(MASK(a < b), a, b); }
#endif
static inline real size(real x) { return value(bits(x) & 0x7fffffffffffffffLL); }
#define K(x) ((x) - (real){0}) /* a constant in every lane */
#if LANES == 1
#define APART inline
#else
#define APART __attribute__((noinline)) /* a library's function for every lane: too much text to repeat */
#endif
#define EACH(kind, name, call) /* through an array: compilers make one instruction of sqrt and floor */ \
  static kind real name(real x) { \
    double a[LANES]; \
    memcpy(a, &x, sizeof a); \
    for (int i = 0; i < LANES; i++) a[i] = call(a[i]); \
    memcpy(&x, a, sizeof a); \
    return x; \
  }
#define PAIR(name, call) \
  static APART real name(real x, real y) { \
    double a[LANES], b[LANES]; \
    memcpy(a, &x, sizeof a); \
    memcpy(b, &y, sizeof b); \
    for (int i = 0; i < LANES; i++) a[i] = call(a[i], b[i]); \
    memcpy(&x, a, sizeof a); \
    return x; \
  }

static inline double one_sign(double x) { return (x > 0) - (x < 0); }
static inline double one_uniform(double x) { return sqrt(3.0) * erf(x * sqrt(0.5)); } /* of a normal number */
EACH(inline, each_sqrt, sqrt) EACH(inline, each_floor, floor) EACH(inline, each_ceil, ceil)
EACH(inline, each_sign, one_sign)
EACH(APART, each_exp, exp) EACH(APART, each_log, log) EACH(APART, each_tan, tan) EACH(APART, each_tanh, tanh)
EACH(APART, each_asin, asin) EACH(APART, each_acos, acos) EACH(APART, each_atan, atan) EACH(APART, each_sinh, sinh)
EACH(APART, each_cosh, cosh) EACH(APART, each_uniform, one_uniform)
PAIR(each_pow, pow) PAIR(each_atan2, atan2) PAIR(each_hypot, hypot) PAIR(each_fmod, fmod)

#if LANES == 8 && defined(__AVX512DQ__)
static inline int nowhere(whole m) { return _mm512_movepi64_mask((__m512i)m) == 0; }
static inline real inverse(real x) { /* 14 bits, doubled twice: a division takes several times as long */
  real r = (real)_mm512_rcp14_pd((__m512d)x);
  r = r + r * (1.0 - x * r);
  return r + r * (1.0 - x * r);
}
#else
static inline int nowhere(whole m) {
  int64_t any = 0;
  for (int i = 0; i < LANES; i++) any |= LANE(m, i);
  return any == 0;
}
static inline real inverse(real x) { return 1.0 / x; }
#endif

/* sin(x) = (-1)^n sin(x - n pi) with the nearest n, cos(x) = sin(x + pi/2); between the zeros an odd polynomial of degree
   15. One machine waits for chains of operations, so its terms stand in pairs (Estrin); many lanes wait for the number of
   operations. Absolute error below 2e-15 up to 1e5 rad.                                                             */
#define ONE 0.9999999999999998
#define THREE -0.16666666666666075
#define FIVE 0.00833333333328281
#define SEVEN -0.00019841269824874834
#define NINE 2.755731661057137e-06
#define ELEVEN -2.505188203572492e-08
#define THIRTEEN 1.6048170941500553e-10
#define FIFTEEN -7.37441787774225e-13
static inline real sine_of_part(real x, real half) { /* sin of x + half pi */
  const double shift = 6755399441055744.0; /* 1.5 * 2^52: its last bits are the nearest whole number */
  real counted = x * 0.31830988618379067154 + half + shift, n = counted - shift - half;
  real r = (x - n * 3.14159265358979311600) - n * 1.22464679914735317723e-16;
  real t = r * r;
#if LANES == 1
  real t2 = t * t, a = ONE + t * THREE, b = FIVE + t * SEVEN, c = NINE + t * ELEVEN, d = THIRTEEN + t * FIFTEEN;
  real s = (a + t2 * b) + t2 * t2 * (c + t2 * d);
#else
  real s = ONE + t * (THREE + t * (FIVE + t * (SEVEN + t * (NINE + t * (ELEVEN + t * (THIRTEEN + t * FIFTEEN))))));
#endif
  return value(bits(r * s) ^ (bits(counted) << 63));
}
/* A mover in its air gap tilts by milliradians: there these terms of the series are right to the last bit. */
#define TINY(x) __builtin_expect(nowhere(MASK((x) * (x) > 4e-4)), 1)
static inline real tilt_sine(real x, real z) {
  if (TINY(x)) return x + x * z * (-1.0 / 6 + z * (1.0 / 120 + z * (-1.0 / 5040)));
  return sine_of_part(x, (real){0});
}
static inline real tilt_cosine(real x, real z) {
  if (TINY(x)) return 1.0 + z * (-1.0 / 2 + z * (1.0 / 24 + z * (-1.0 / 720)));
  return sine_of_part(x, (real){0} + 0.5);
}
#define tilt(x) ((x) * (x))
#define tilt_secant(x, z) inverse(tilt_cosine(x, z))
static inline real sine(real x) { return sine_of_part(x, (real){0}); }
static inline real cosine(real x) { return sine_of_part(x, (real){0} + 0.5); }
/* The same where it is known to be within the square root of NEAR; `range` is the largest square that was met. */
#define NEAR 1e-4
static inline real near_square(real *range, real x) {
  real z = x * x;
  *range = larger(*range, z);
  return z;
}
#define near(x) near_square(range, x)
#define near_sine(x, z) ((x) + (x) * (z) * (-1.0 / 6 + (z) * (1.0 / 120)))
#define near_cosine(x, z) (1.0 + (z) * (-1.0 / 2 + (z) * (1.0 / 24 + (z) * (-1.0 / 720))))
#define near_secant(x, z) (1.0 + (z) * (1.0 / 2 + (z) * (5.0 / 24 + (z) * (61.0 / 720))))

/*MODEL*/

/* v0(z), linear between the points of the grid: rows of `table` are z, v0 and dv0/dz. */
enum { WIDTH = 1 + 2 * FORCES };
#if LANES == 1
static inline void look_up(long n, const double *table, long *hint, double at, double *v) {
  long k = *hint; /* where the search stood before */
  while (k > 0 && !(at >= table[k * WIDTH])) k--;
  while (k < n - 2 && at > table[(k + 1) * WIDTH]) k++;
  const double *row = table + (*hint = k) * WIDTH;
  for (int j = 0; j < FORCES; j++) v[j] = row[1 + j] + (at - row[0]) * row[1 + FORCES + j];
}

/* Rows of `samples` control periods from the one of number `first` on; `state` is taken and left behind. Where a sample is
   no whole number of substeps, it begins with the first substep after it.                                             */
void run(long first, long samples, double substeps, const double *theta, long grid, const double *table, double *state,
         const double *given, const double *noise, const double *fast, double *rows) {
  double c[CONSTANTS + 1], y[OUTPUTS], v[FORCES], held[HELD], next[STATES];
  long hint = 0, done = (long)ceil((double)first * substeps - 1e-6);
  prepare(theta, c);
  for (long k = first; k < first + samples; k++, given += GIVEN, noise += OUTPUTS, rows += ROW) {
    double at;
    sense(c, state, given, noise, y, &at);
    look_up(grid, table, &hint, at, v);
    decide(c, state, given, y, v, next + MACHINE, held, rows);
    const long end = (long)ceil((double)(k + 1) * substeps - 1e-6);
    for (; done < end; done++, fast += JITTER) substep(c, state, held, given, fast, state);
    memcpy(state + MACHINE, next + MACHINE, (STATES - MACHINE) * sizeof *state);
  }
}
#else
/* Noise: SplitMix64 of a lane's key and a counter, 32 bits for the radius and 32 for the angle of Box-Muller. The
   same numbers as noise.py, whatever the lane.                                                                     */
typedef uint64_t bits64 __attribute__((vector_size(8 * LANES)));
static inline real logarithm(real x) { /* of 2^-33 < x < 1; fdlibm's */
  whole b = bits(x) - 0x3fe6a09e667f3bcdLL; /* from sqrt(1/2) on */
  whole e = b >> 52;
  real f = value((b & 0xfffffffffffffLL) + 0x3fe6a09e667f3bcdLL) - 1.0;
  real s = f * inverse(2.0 + f), z = s * s, half = 0.5 * f * f;
  real tail = z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 + z * (2.857142874366239149e-01
    + z * (2.222219843214978396e-01 + z * (1.818357216161805012e-01 + z * (1.531383769920937332e-01
    + z * 1.479819860511658591e-01))))));
  real n = __builtin_convertvector(e, real);
  return n * 6.93147180369123816490e-01 - ((half - (s * (half + tail) + n * 1.90821492927058770002e-10)) - f);
}
/* Within an eighth of a turn: fdlibm's polynomials. */
static inline real sin_near(real r) {
  real z = r * r, w = z * z;
  real low = -1.66666666666666324348e-01 + z * 8.33333333332248946124e-03;
  real mid = -1.98412698298579493134e-04 + z * 2.75573137070700676789e-06;
  real top = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10;
  return r + r * z * (low + w * (mid + w * top));
}
static inline real cos_near(real r) {
  real z = r * r, w = z * z;
  real low = 4.16666666666666019037e-02 + z * -1.38888888888741095749e-03;
  real mid = 2.48015872894767294178e-05 + z * -2.75573143513906633035e-07;
  real top = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11;
  return (1.0 - 0.5 * z) + w * (low + w * (mid + w * top));
}
static inline void two_normals(bits64 key, uint64_t count, real *a, real *b) {
  bits64 x = key + count * 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  x = x ^ (x >> 31);
  const double unit = 1.0 / 4294967296.0, quarter = 1.57079632679489661923 / 1073741824.0;
  real u = (__builtin_convertvector((whole)(x >> 32), real) + 0.5) * unit;
  /* The angle: a quadrant, and 30 bits within it about its middle. */
  whole q = (whole)((x >> 30) & 3);
  real r = (__builtin_convertvector((whole)(x & 0x3fffffff), real) - 536870911.5) * quarter;
  real radius = each_sqrt(-2.0 * logarithm(u)), s = sin_near(r) * radius, c = cos_near(r) * radius;
  whole odd = -(q & 1);
  *a = value(((bits(s) & odd) | (bits(c) & ~odd)) ^ (((q + 1) & 2) << 62));
  *b = value(((bits(c) & odd) | (bits(s) & ~odd)) ^ ((q & 2) << 62));
}

/* In lanes: each lane's row of v0 at its z, in parts of LANES forces, and the rows transposed. */
typedef struct { long n, even; const double *table; double first, step, per_metre, *values, *slopes; } Grid;
enum { PADDED = (FORCES + LANES - 1) / LANES * LANES };

#ifdef __clang__
#define MIXED(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
#else
#define MIXED(x, y, ...) __builtin_shuffle(x, y, (whole){__VA_ARGS__})
#endif
#define TURN(i, j, low, high) { \
    real x = row[i], y = row[j]; \
    row[i] = MIXED(x, y, low), row[j] = MIXED(x, y, high); \
  }
#define EVEN 0, 8, 2, 10, 4, 12, 6, 14
#define ODD 1, 9, 3, 11, 5, 13, 7, 15
#define PAIRS 0, 1, 8, 9, 4, 5, 12, 13
#define OTHERS 2, 3, 10, 11, 6, 7, 14, 15
#define FRONT 0, 1, 2, 3, 8, 9, 10, 11
#define BACK 4, 5, 6, 7, 12, 13, 14, 15
static inline void transpose(real *row) { /* LANES is 8 */
  TURN(0, 1, EVEN, ODD) TURN(2, 3, EVEN, ODD) TURN(4, 5, EVEN, ODD) TURN(6, 7, EVEN, ODD)
  TURN(0, 2, PAIRS, OTHERS) TURN(1, 3, PAIRS, OTHERS) TURN(4, 6, PAIRS, OTHERS) TURN(5, 7, PAIRS, OTHERS)
  TURN(0, 4, FRONT, BACK) TURN(1, 5, FRONT, BACK) TURN(2, 6, FRONT, BACK) TURN(3, 7, FRONT, BACK)
}
static inline void look_up(const Grid *g, real at, real *v) {
  real u = larger(smaller((at - g->first) * g->per_metre, (real){0} + (double)(g->n - 2)), (real){0});
  whole index = __builtin_convertvector(u, whole);
  real beyond = at - (g->first + g->step * __builtin_convertvector(index, real));
  if (!g->even)
    for (int i = 0; i < LANES; i++) {
      long low = 0, high = g->n - 1;
      while (high - low > 1) {
        long k = (low + high) / 2;
        if (at[i] >= g->table[k * WIDTH]) low = k;
        else high = k;
      }
      index[i] = low, beyond[i] = at[i] - g->table[low * WIDTH];
    }
  for (int part = 0; part < PADDED; part += LANES) {
    real row[LANES], base, slope;
#pragma GCC unroll 8
    for (int i = 0; i < LANES; i++) {
      long k = index[i];
      memcpy(&base, g->values + k * PADDED + part, sizeof base);
      memcpy(&slope, g->slopes + k * PADDED + part, sizeof slope);
      row[i] = base + beyond[i] * slope;
    }
    transpose(row);
    for (int j = part; j < FORCES && j < part + LANES; j++) v[j] = row[j - part];
  }
}

/* What a group of machines is between two samples. */
typedef struct { real state[STATES], kept[DIGEST + 1]; } Group;

/* One sample: 0 where `near` turns out not to hold, and `after` means nothing. Mostly the first look tells. Which of the
   two a sample is computed by depends on nothing but that sample, so that it can be computed again to the bit.       */
#define SAMPLE(name, near, attributes, ...) \
  static attributes int name(const real *c, const Group *m, Group *after, const Grid *grid, long substeps, \
                             const double *given, const real *noise) { \
    real range = {0}, at, y[OUTPUTS], v[FORCES], held[HELD], row[ROW]; \
    const real *from = m->state; \
    sense##near(__VA_ARGS__ c, m->state, given, noise, y, &at); \
    if (!nowhere(MASK(range > NEAR))) return 0; \
    look_up(grid, at, v); \
    decide##near(__VA_ARGS__ c, m->state, given, y, v, after->state + MACHINE, held, row); \
    digest(c, m->kept, row, given, after->kept); \
    for (long i = 0; i < substeps; i++, from = after->state) \
      substep##near(__VA_ARGS__ c, from, held, given, 0, after->state); \
    return nowhere(MASK(range > NEAR)); \
  }
SAMPLE(sample_near, _near, inline, &range, )
SAMPLE(sample, , __attribute__((noinline, cold)), )

/* LANES machines at once: only digests are kept. */
static void run_group(long samples, long substeps, const double *theta, const Grid *grid, double *states,
                      const double *given, long uniform, const double *scales, const uint64_t *keys, double *digests) {
  Group m[2], *now = m, *after = m + 1, *before;
  real c[CONSTANTS + 1], sigma[OUTPUTS], t[THETA + 1], noise[2 * OUTPUTS];
  int noisy = 0;
  bits64 key;
  memcpy(&key, keys, sizeof key);
  memcpy(t, theta, sizeof(real) * THETA);
  memcpy(now->state, states, sizeof now->state);
  memcpy(now->kept, digests, sizeof(real) * DIGEST);
  prepare(t, c);
  memcpy(sigma, scales, sizeof sigma);
  for (int j = 0; j < OUTPUTS * LANES; j++) noisy |= scales[j] != 0;
  memset(noise, 0, sizeof noise);
  for (long k = 0; k < samples; k++, given += GIVEN) {
    const real *drawn = noise + k % 2 * OUTPUTS;
    if (noisy && k % 2 == 0) {
      for (int j = 0; j < OUTPUTS; j++)
        two_normals(key, (uint64_t)(k / 2 * OUTPUTS + j), noise + 2 * j, noise + 2 * j + 1);
      for (int j = 0; j < 2 * OUTPUTS; j++)
        noise[j] = (uniform ? each_uniform(noise[j]) : noise[j]) * sigma[j % OUTPUTS];
    }
    if (!sample_near(c, now, after, grid, substeps, given, drawn))
      sample(c, now, after, grid, substeps, given, drawn);
    before = now, now = after, after = before;
  }
  memcpy(states, now->state, sizeof now->state);
  memcpy(digests, now->kept, sizeof(real) * DIGEST);
}

/* Groups of LANES machines, one after the other; states and digests are taken and left behind. */
void run_many(long groups, long samples, long substeps, const double *theta, long points, const double *table,
              double *states, const double *given, long uniform, const double *sigma, const uint64_t *keys,
              double *digests) {
  const size_t size = (size_t)points * PADDED * sizeof(double);
  double *rows = aligned_alloc(64, 2 * size), first = table[0];
  if (!rows) abort();
  double step = (table[(points - 1) * WIDTH] - first) / (double)(points - 1);
  Grid grid = {points, 1, table, first, step, 1 / step, rows, rows + points * PADDED};
  memset(rows, 0, 2 * size);
  for (long k = 0; k < points; k++) {
    grid.even &= fabs((table[k * WIDTH] - first) * grid.per_metre - (double)k) < 1e-9;
    memcpy(rows + k * PADDED, table + k * WIDTH + 1, FORCES * sizeof(double));
    memcpy(rows + (points + k) * PADDED, table + k * WIDTH + 1 + FORCES, FORCES * sizeof(double));
  }
  for (long g = 0; g < groups; g++)
    run_group(samples, substeps, theta + g * THETA * LANES, &grid, states + g * STATES * LANES, given, uniform,
              sigma + g * OUTPUTS * LANES, keys + g * LANES, digests + g * DIGEST * LANES);
  free(rows);
}
#endif
