/* The loop around one control period of machine and controller: the frame of every compiled engine.

   The functions `prepare`, `foresee`, `sense`, `decide`, `substep` and those of the digest are generated from CasADi
   expressions by translate.py, and stand at the mark below; the sizes are #defines before it. c, d and g are those of
   once.py. LANES machines run side by side, one in each lane of a SIMD register; with LANES 1 a `real` is a double and
   the rows of every sample are kept.                                                                                */

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
static inline real sine_of_part(real x, int halves) { /* sin of x + halves pi / 2; halves is 0 or 1 */
  const double shift = 6755399441055744.0; /* 1.5 * 2^52: its last bits are the nearest whole number */
  real turns = x * 0.31830988618379067154;
  real counted = (halves ? turns + 0.5 : turns) + shift, n = counted - shift;
  if (halves) n -= 0.5;
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
static inline real odd(real t) { /* sin(pi r) / r of t = r^2, |r| up to 1/2; absolute error below 4e-16 */
  const double one = 3.1415926535897927, three = -5.167712780049786, five = 2.550164039861884, seven = -0.5992645288256148;
  const double nine = 0.08214587882077493, eleven = -0.007370364352718201, thirteen = 0.0004659870919775173;
  const double fifteen = -2.1133714397960184e-05;
#if LANES == 1
  real t2 = t * t, a = one + t * three, b = five + t * seven, c = nine + t * eleven, d = thirteen + t * fifteen;
  return (a + t2 * b) + t2 * t2 * (c + t2 * d);
#else
  return one + t * (three + t * (five + t * (seven + t * (nine + t * (eleven + t * (thirteen + t * fifteen))))));
#endif
}
static inline real sine_of_pi(real turns, int halves) { /* sin of pi (turns + halves / 2) */
  const double shift = 6755399441055744.0;
  real counted = (halves ? turns + 0.5 : turns) + shift, n = counted - shift;
  real r = halves ? turns - (n - 0.5) : turns - n;
  return value(bits(r * odd(r * r)) ^ (bits(counted) << 63));
}
static inline real sine(real x) { return sine_of_part(x, 0); }
static inline real cosine(real x) { return sine_of_part(x, 1); }
/* A mover in its air gap tilts by milliradians: there these terms of the series are right to the last bit. */
#define TINY(x) __builtin_expect(nowhere(MASK((x) * (x) > 4e-4)), 1)
static inline real tilt_sine(real x, real z) {
  if (TINY(x)) return x + x * z * (-1.0 / 6 + z * (1.0 / 120 + z * (-1.0 / 5040)));
  return sine(x);
}
static inline real tilt_cosine(real x, real z) {
  if (TINY(x)) return 1.0 + z * (-1.0 / 2 + z * (1.0 / 24 + z * (-1.0 / 720)));
  return cosine(x);
}
#define tilt(x) ((x) * (x))
#define tilt_secant(x, z) inverse(tilt_cosine(x, z))
/* The same where it is known to be within the square root of NEAR, with the terms that are above half a unit in the last
   place there; `range` is the largest square that was met.                                                         */
#define NEAR 2.5e-5
static inline real near_square(real *range, real x) {
  real z = x * x;
  *range = larger(*range, z);
  return z;
}
#define near(x) near_square(range, x)
#define near_sine(x, z) ((x) + (x) * (z) * (-1.0 / 6 + (z) * (1.0 / 120)))
#define near_cosine(x, z) (1.0 + (z) * (-1.0 / 2 + (z) * (1.0 / 24)))
#define near_secant(x, z) (1.0 + (z) * (1.0 / 2 + (z) * (5.0 / 24 + (z) * (61.0 / 720))))

/*MODEL*/

/* v0(z), linear between the points of the grid: rows of the table are z, v0 and dv0/dz. Only columns that are not zero
   are looked up.                                                                                                    */
enum { WIDTH = 1 + 2 * FORCES };
static const int column[COLUMNS + 1] = {COLUMN};
#if LANES == 1
typedef struct { long n, hint; const double *table; } Grid;
static inline void look_up(Grid *g, double at, double *v) {
  long k = g->hint; /* where the search stood before */
  while (k > 0 && !(at >= g->table[k * WIDTH])) k--;
  while (k < g->n - 2 && at > g->table[(k + 1) * WIDTH]) k++;
  const double *row = g->table + (g->hint = k) * WIDTH + 1;
  for (int j = 0; j < COLUMNS; j++)
    v[column[j]] = row[column[j]] + (at - row[-1]) * row[FORCES + column[j]];
}
#else
/* In lanes: each lane's row at its z, in parts of LANES numbers, and the rows transposed: values, then slopes. */
typedef struct { long n, even; const double *table; double first, step, per_metre, *rows; } Grid;
enum { PADDED = (2 * COLUMNS + LANES - 1) / LANES * LANES };

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
  real beyond = at - (g->first + g->step * __builtin_convertvector(index, real)), row[PADDED + 1];
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
  index *= PADDED;
#pragma GCC unroll 8
  for (int part = 0; part < PADDED; part += LANES) {
#pragma GCC unroll 8
    for (int i = 0; i < LANES; i++) memcpy(row + part + i, g->rows + index[i] + part, sizeof *row);
    transpose(row + part);
  }
  for (int j = 0; j < COLUMNS; j++) v[column[j]] = row[j] + beyond * row[COLUMNS + j];
}
#endif

/* One sample: the control law, and the machine's motion until the next sample. 0 where `near` turns out not to hold, and
   what was written means nothing. Which of the two a sample is computed by depends on nothing but that sample, so that
   it can be computed again to the bit.                                                                              */
#define COLD __attribute__((noinline, cold))
#if COORDINATES
#define ENTER(near, ...) enter##near(__VA_ARGS__ c, d, g, from, held, work);
#define LEAVE(near, ...) leave##near(__VA_ARGS__ c, d, g, work, from, held, after);
#else
#define ENTER(near, ...) memcpy(work, from, sizeof work);
#define LEAVE(near, ...) memcpy(after, work, sizeof work);
#endif
#define SAMPLE(near, attributes, ...) \
  static attributes int control##near(const real *c, const double *d, const double *g, const real *state, Grid *grid, \
                                      const double *given, const real *noise, real *next, real *held, real *row) { \
    real range = {0}, at, y[OUTPUTS], v[FORCES]; \
    sense##near(__VA_ARGS__ c, d, g, state, given, noise, y, &at); \
    look_up(grid, at, v); \
    decide##near(__VA_ARGS__ c, d, g, state, given, y, v, next, held, row); \
    return nowhere(MASK(range > NEAR)); \
  } \
  static attributes int motion##near(const real *c, const double *d, const double *g, long substeps, const real *from, \
                                     const real *held, const double *given, const real *fast, real *after) { \
    real range = {0}, work[WORKING]; \
    ENTER(near, __VA_ARGS__) \
    for (long i = 0; i < substeps; i++, fast += JITTER) \
      substep##near(__VA_ARGS__ c, d, g, work, held, given, fast, work); \
    LEAVE(near, __VA_ARGS__) \
    return nowhere(MASK(range > NEAR)); \
  }
#if TILTED
SAMPLE(_near, inline, &range, )
SAMPLE(, COLD, )
#else
SAMPLE(, inline, )
#define control_near control
#define motion_near motion
#endif

#if LANES == 1
/* Rows of `samples` control periods from the one of number `first` on; `state` is taken and left behind. Where a sample is
   no whole number of substeps, it begins with the first substep after it.                                             */
void run(long first, long samples, double substeps, const double *theta, long points, const double *table, double *state,
         const double *given, const double *noise, const double *fast, double *rows) {
  double c[CONSTANTS + 1], d[SHARED + 1], g[FORESEEN + 1], held[HELD], m[2][STATES], *now = m[0], *after = m[1], *before;
  Grid grid = {points, 0, table};
  long done = (long)ceil((double)first * substeps - 1e-6);
  prepare(theta, c, d);
  memcpy(now, state, sizeof *m);
  for (long k = first; k < first + samples; k++, given += GIVEN, noise += OUTPUTS, rows += ROW) {
    const long end = (long)ceil((double)(k + 1) * substeps - 1e-6), count = end - done;
    foresee(d, given, g);
    int near = control_near(c, d, g, now, &grid, given, noise, after + MACHINE, held, rows);
    if (!near) control(c, d, g, now, &grid, given, noise, after + MACHINE, held, rows);
    if (!near || !motion_near(c, d, g, count, now, held, given, fast, after))
      motion(c, d, g, count, now, held, given, fast, after);
    before = now, now = after, after = before, done = end, fast += count * JITTER;
  }
  memcpy(state, now, sizeof *m);
}
#else
/* Noise: SplitMix64 of a lane's key and a counter, 32 bits for the radius and 32 for the angle of Box-Muller, in single
   precision. Every operation rounds as those of noise.py do, so none may be contracted: the same numbers to the bit.  */
typedef uint64_t bits64 __attribute__((vector_size(8 * LANES)));
typedef uint32_t bits32 __attribute__((vector_size(8 * LANES))); /* twice as many */
typedef int32_t whole32 __attribute__((vector_size(8 * LANES)));
typedef float single __attribute__((vector_size(8 * LANES)));
typedef float half_singles __attribute__((vector_size(4 * LANES)));
enum { TOGETHER = 4 }; /* samples whose noise is drawn at once */

static bits64 split_mix(bits64 key, uint64_t count) {
  bits64 x = key + count * 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}
#ifdef __clang__
#define CHOSEN(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
#define UNCONTRACTED __attribute__((noinline))
#else
#define CHOSEN(x, y, ...) __builtin_shuffle(x, y, (bits32){__VA_ARGS__})
#define UNCONTRACTED __attribute__((noinline, optimize("fp-contract=off")))
#endif
#if defined(__AVX512F__) && LANES == 8 /* macros: nothing is inlined where other options hold */
#define ROOT(x) ((single)_mm512_sqrt_ps((__m512)(x)))
#define WIDENED(x) ((real)_mm512_cvtps_pd((__m256)(x)))
#else
static single root(single x) {
  for (int i = 0; i < 2 * LANES; i++) x[i] = sqrtf(x[i]);
  return x;
}
#define ROOT(x) root(x)
#define WIDENED(x) __builtin_convertvector(x, real)
#endif
/* Normal numbers of TOGETHER samples from `count` on, a multiple of it, times their scales: two of each counter. */
static UNCONTRACTED void draw(bits64 key, uint64_t count, const real *scale, real *noise) {
#ifdef __clang__
#pragma clang fp contract(off)
#endif
  count = count / 2 * OUTPUTS;
  for (int j = 0; j < 2 * OUTPUTS; j += 2) {
    bits32 x = (bits32)split_mix(key, count + j), w = (bits32)split_mix(key, count + j + 1);
    bits32 high = CHOSEN(x, w, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    bits32 low = CHOSEN(x, w, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    /* u = m 2^k with m from sqrt(1/2) to sqrt(2); log m by a polynomial, relative error 2e-7 */
    bits32 m = (bits32)__builtin_convertvector(high | 1, single);
    whole32 k = (whole32)(m - 0x3f3504f3u) >> 23;
    single f = (single)(m - ((bits32)k << 23)) - 1.0f;
    single p = 0.16338027f + f * -0.10378417f;
    p = -0.17212471f + f * p;
    p = 0.19884252f + f * p;
    p = -0.24971558f + f * p;
    p = 0.33335607f + f * p;
    p = -0.50000344f + f * p;
    p = 0.99999992f + f * p;
    single radius = ROOT(-2.0f * (f * p + 0.69314718f * __builtin_convertvector(k - 32, single)));
    /* the right half of the circle in half turns, and either sign */
    single a = __builtin_convertvector((whole32)((low << 1) ^ 0x80000000u), single) * 0x1p-32f, t = a * a;
    radius = (single)((bits32)radius ^ (low & 0x80000000u));
    single s = -0.59829129f + t * 0.07765766f, c = -1.33187657f + t * 0.21968961f;
    s = 2.5500775f + t * s, c = 4.05841135f + t * c;
    s = -5.1677101f + t * s, c = -4.93479283f + t * c;
    s = 3.14159264f + t * s, c = 0.99999995f + t * c;
    single pair[2] = {radius * c, radius * (a * s)};
    half_singles part[2];
    for (int i = 0; i < 2; i++) {
      memcpy(part, &pair[i], sizeof part);
      for (int each = 0; each < 2; each++) {
        const int at = 2 * (j + each) + i;
        noise[at] = WIDENED(part[each]) * scale[at];
      }
    }
  }
}

#if CRUISE
static COLD void count(const real *c, const double *d, const double *g, real *kept, const real *row,
                       const double *given) {
  digest(c, d, g, kept, row, given, kept);
}
#endif
/* A sample by the general functions. */
static COLD void sample(const real *c, const double *d, const double *g, const real *now, Grid *grid, long substeps,
                        const double *given, const real *noise, real *kept, real *after) {
  real held[HELD], row[ROW];
  control(c, d, g, now, grid, given, noise, after + MACHINE, held, row);
  digest(c, d, g, kept, row, given, kept);
  motion(c, d, g, substeps, now, held, given, 0, after);
}
/* A sample by the short ones where they hold. What is rare takes copies, so that the arrays themselves stay registers. */
static inline void sample_near(const real *c, const double *d, const double *g, const real *now, Grid *grid,
                               long substeps, const double *given, const real *noise, real *kept, real *after) {
  real held[HELD], row[ROW];
  if (!control_near(c, d, g, now, grid, given, noise, after + MACHINE, held, row)) {
    sample(c, d, g, now, grid, substeps, given, noise, kept, after);
    return;
  }
#if CRUISE
  real flies;
  cruises(c, d, g, kept, row, given, &flies);
  if (__builtin_expect(nowhere(MASK(flies == 0.0)), 1)) {
    cruise(c, d, g, kept, row, given, kept);
  } else {
    real copy[ROW];
    memcpy(copy, row, sizeof copy);
    count(c, d, g, kept, copy, given);
  }
#else
  digest(c, d, g, kept, row, given, kept);
#endif
  if (!motion_near(c, d, g, substeps, now, held, given, 0, after)) {
    real copy[HELD];
    memcpy(copy, held, sizeof copy);
    motion(c, d, g, substeps, now, copy, given, 0, after);
  }
}

/* LANES machines at once: only digests are kept. g: of all samples. */
static void run_group(long samples, long substeps, const real *c, const double *d, const double *g, Grid *grid,
                      double *states, const double *given, long uniform, const double *scales, const uint64_t *keys,
                      double *digests) {
  real m[2][STATES], *now = m[0], *after = m[1], *before, kept[DIGEST + 1];
  real sigma[TOGETHER * OUTPUTS], noise[TOGETHER * OUTPUTS], ones[TOGETHER * OUTPUTS];
  int noisy = 0;
  bits64 key;
  for (int j = 0; j < TOGETHER * OUTPUTS; j++) ones[j] = (real){0} + 1.0;
  memcpy(&key, keys, sizeof key);
  memcpy(now, states, sizeof *m);
  memcpy(kept, digests, sizeof(real) * DIGEST);
  for (int k = 0; k < TOGETHER; k++) memcpy(sigma + k * OUTPUTS, scales, sizeof sigma / TOGETHER);
  for (int j = 0; j < OUTPUTS * LANES; j++) noisy |= scales[j] != 0;
  memset(noise, 0, sizeof noise);
  for (long k = 0; k < samples; k++, given += GIVEN, g += FORESEEN) {
    const real *drawn = noise + k % TOGETHER * OUTPUTS;
    if (noisy && k % TOGETHER == 0) {
      draw(key, (uint64_t)k, uniform ? ones : sigma, noise);
      for (int j = 0; j < TOGETHER * OUTPUTS && uniform; j++) noise[j] = each_uniform(noise[j]) * sigma[j];
    }
    __asm__("" : "+r"(d)); /* else numbers in every lane are kept from sample to sample, in more memory than is near */
    sample_near(c, d, g, now, grid, substeps, given, drawn, kept, after);
    before = now, now = after, after = before;
  }
  memcpy(states, now, sizeof *m);
  memcpy(digests, kept, sizeof(real) * DIGEST);
}

/* Groups of LANES machines, one after the other; states and digests are taken and left behind. */
void run_many(long groups, long samples, long substeps, const double *theta, long points, const double *table,
              double *states, const double *given, long uniform, const double *sigma, const uint64_t *keys,
              double *digests) {
  const size_t size = (size_t)(points * PADDED + LANES) * sizeof(double);
  double *rows = aligned_alloc(64, size), *g = malloc((size_t)(samples * FORESEEN + 1) * sizeof *g), first = table[0];
  if (!rows || !g) abort();
  double step = (table[(points - 1) * WIDTH] - first) / (double)(points - 1), d[SHARED + 1];
  Grid grid = {points, 1, table, first, step, 1 / step, rows};
  memset(rows, 0, size);
  for (long k = 0; k < points; k++) {
    grid.even &= fabs((table[k * WIDTH] - first) * grid.per_metre - (double)k) < 1e-9;
    for (int j = 0; j < COLUMNS; j++)
      for (int part = 0; part < 2; part++)
        rows[k * PADDED + part * COLUMNS + j] = table[k * WIDTH + 1 + part * FORCES + column[j]];
  }
  for (long i = 0; i < groups; i++) {
    real c[CONSTANTS + 1], t[THETA + 1];
    memcpy(t, theta + i * THETA * LANES, sizeof(real) * THETA);
    prepare(t, c, d); /* d is the same for all groups */
    for (long k = 0; k < samples && !i; k++) foresee(d, given + k * GIVEN, g + k * FORESEEN);
    run_group(samples, substeps, c, d, g, &grid, states + i * STATES * LANES, given, uniform,
              sigma + i * OUTPUTS * LANES, keys + i * LANES, digests + i * DIGEST * LANES);
  }
  free(rows);
  free(g);
}
#endif
