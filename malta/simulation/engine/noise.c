/* Noise: SplitMix64 of a lane's key and a counter, 32 bits for the radius and 32 for the angle of Box-Muller, in single
   precision. Every operation rounds as those of readings.py do, so none may be contracted: the same numbers to the bit.  */
typedef uint64_t bits64 __attribute__((vector_size(8 * LANES)));
typedef uint32_t bits32 __attribute__((vector_size(8 * LANES))); /* twice as many */
typedef int32_t whole32 __attribute__((vector_size(8 * LANES)));
typedef float single __attribute__((vector_size(8 * LANES)));
typedef float half_singles __attribute__((vector_size(4 * LANES)));
enum { TOGETHER = 4 }; /* samples whose noise is drawn at once */

static bits64 split_mix(bits64 key, uint64_t count) {
  bits64 x = key + (uint64_t)(count * 0x9e3779b97f4a7c15ULL); /* clang takes no long long beside uint64_t */
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
#if LANES == 8
#define ODD_WORDS 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31
#define EVEN_WORDS 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30
#else /* 4 */
#define ODD_WORDS 1, 3, 5, 7, 9, 11, 13, 15
#define EVEN_WORDS 0, 2, 4, 6, 8, 10, 12, 14
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
#pragma GCC unroll 8
  for (int j = 0; j < 2 * OUTPUTS; j += 2) {
    bits32 x = (bits32)split_mix(key, count + j), w = (bits32)split_mix(key, count + j + 1);
    bits32 high = CHOSEN(x, w, ODD_WORDS);
    bits32 low = CHOSEN(x, w, EVEN_WORDS);
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
