/* Numbers of compiled engines: one in a double, or LANES of them in a SIMD register, and the operations of engines.py
   on either. A whole is a mask: -1 where something is true, and 0 elsewhere.                                       */

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
EACH(APART, each_asinh, asinh) EACH(APART, each_acosh, acosh) EACH(APART, each_atanh, atanh) EACH(APART, each_erf, erf)
EACH(APART, each_expm1, expm1) EACH(APART, each_log1p, log1p)
PAIR(each_pow, pow) PAIR(each_atan2, atan2) PAIR(each_hypot, hypot) PAIR(each_fmod, fmod)
PAIR(each_remainder, remainder) PAIR(each_copysign, copysign)

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
#if defined(__GNUC__) && !defined(__clang__) && (defined(__FMA__) || defined(__aarch64__))
static inline real less_turns(real x, real n) { /* x - n pi; products are contracted, so that none is rounded */
  return (x - n * 3.14159265358979311600) - n * 1.22464679914735317723e-16;
}
#else
static inline real less_turns(real x, real n) { /* x - n pi; products of n, up to 16 bits, with 36 bits of pi are exact */
  return ((x - n * 3.1415926535846666) - n * 5.1266883031679116e-12) - n * 2.1125998133974855e-23;
}
#endif
static inline real sine_of_part(real x, int halves) { /* sin of x + halves pi / 2; halves is 0 or 1 */
  const double shift = 6755399441055744.0; /* 1.5 * 2^52: its last bits are the nearest whole number */
  real turns = x * 0.31830988618379067154;
  real counted = (halves ? turns + 0.5 : turns) + shift, n = counted - shift;
  if (halves) n -= 0.5;
  real r = less_turns(x, n);
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
