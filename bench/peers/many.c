/* Many machines at once, W to a vector, one controller and one reference: largest errors and touchdowns. */
#include <math.h>
#include <string.h>

#if defined __AVX512F__
#define W 8
#elif defined __AVX__
#define W 4
#else
#define W 2
#endif
typedef double real __attribute__((vector_size(8 * W)));
#include "loop.h"

typedef int64_t mask __attribute__((vector_size(8 * W)));
typedef uint64_t words __attribute__((vector_size(8 * W)));
typedef float singles __attribute__((vector_size(8 * W)));    /* twice as many lanes */
typedef uint32_t halves __attribute__((vector_size(8 * W)));
typedef int32_t indices __attribute__((vector_size(8 * W)));
typedef float narrow __attribute__((vector_size(4 * W)));

#define LANES for (int i = 0; i < W; i++)

#if W == 8
#include <immintrin.h>
static inline real larger(real a, real b) { return _mm512_max_pd(a, b); }   /* b where a is no number */
static inline real smaller(real a, real b) { return _mm512_min_pd(a, b); }
static inline singles root(singles a) { return _mm512_sqrt_ps(_mm512_max_ps(a, (singles){0})); }
#else
static inline real larger(real a, real b) { LANES a[i] = a[i] > b[i] ? a[i] : b[i]; return a; }
static inline real smaller(real a, real b) { LANES a[i] = a[i] < b[i] ? a[i] : b[i]; return a; }
static inline singles root(singles a)
{
    for (int i = 0; i < 2 * W; i++) a[i] = sqrtf(a[i] > 0 ? a[i] : 0);
    return a;
}
#endif
static inline real all(double value) { return value - (real){0}; }
static inline real clamp(real a, double limit) { return larger(smaller(a, all(limit)), all(-limit)); }
static inline real magnitude(real a) { return (real)((mask)a & INT64_MAX); }
static inline real where_equal(real a, real b, double value) { return (real)((a == b) & (mask)all(value)); }
static inline real odd_flips(real a, real counter) { return (real)((mask)a ^ ((mask)counter << 63)); }

/* Noise. xoshiro256++ in every lane, seeded by splitmix64. */
typedef struct { words s[4]; } Stream;

static uint64_t split_mix(uint64_t *state)
{
    uint64_t z = (*state += 0x9e3779b97f4a7c15);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
    z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
    return z ^ (z >> 31);
}

static Stream stream(uint64_t seed, uint64_t group)
{
    Stream r;
    uint64_t state = seed;
    state = split_mix(&state) + group;
    state = split_mix(&state);
    for (int i = 0; i < W; i++)
        for (int j = 0; j < 4; j++) r.s[j][i] = split_mix(&state);
    return r;
}

static inline words draw(Stream *r)
{
    words *s = r->s, sum = s[0] + s[3], result = ((sum << 23) | (sum >> 41)) + s[0], t = s[1] << 17;
    s[2] ^= s[0], s[3] ^= s[1], s[1] ^= s[2], s[0] ^= s[3], s[2] ^= t;
    s[3] = (s[3] << 45) | (s[3] >> 19);
    return result;
}

/* Box-Muller in single precision: 4 W standard normals, none beyond 6.7. */
static inline void normals(Stream *r, singles *z)
{
    halves u = (halves)draw(r), bits = (halves)__builtin_convertvector(u | 1, singles), turn = (halves)draw(r);
    /* u = m 2^k, m from sqrt(1/2) to sqrt(2); log m by a polynomial, error 2e-7 */
    indices k = (indices)(bits - 0x3f3504f3u) >> 23;
    singles f = (singles)(bits - ((halves)k << 23)) - 1;
    singles log_u = f * (0.99999992f + f * (-0.50000344f + f * (0.33335607f + f * (-0.24971558f + f * (0.19884252f
        + f * (-0.17212471f + f * (0.16338027f + f * -0.10378417f)))))))
        + 0.69314718f * (__builtin_convertvector(k, singles) - 32);
    singles radius = root(-2 * log_u);
    /* the right half of the circle, and either sign */
    singles a = __builtin_convertvector((indices)turn >> 1, singles) * 0x1p-31f, t = a * a;
    radius = (singles)((halves)radius ^ (turn << 31));
    z[0] = radius * a * (3.14159264f + t * (-5.1677101f + t * (2.5500775f + t * (-0.59829129f + t * 0.07765766f))));
    z[1] = radius * (0.99999995f + t * (-4.93479283f + t * (4.05841135f + t * (-1.33187657f + t * 0.21968961f))));
}

/* One machine's generator: xoshiro256++ and the ziggurat of 256 layers (Marsaglia and Tsang, as Doornik has it). */
typedef struct { uint64_t s[4]; } Walk;

static double edge[257], share[256];

static double bell(double x) { return exp(-x * x / 2); }

static void build_ziggurat(void)
{
    const double tail = 3.6541528853610088, area = 0.00492867323399;
    edge[0] = area / bell(tail), edge[1] = tail, edge[256] = 0;
    for (int i = 2; i < 256; i++) edge[i] = sqrt(-2 * log(area / edge[i - 1] + bell(edge[i - 1])));
    for (int i = 0; i < 256; i++) share[i] = edge[i + 1] / edge[i];
}

static inline uint64_t next(uint64_t *s)
{
    uint64_t sum = s[0] + s[3], result = ((sum << 23) | (sum >> 41)) + s[0], t = s[1] << 17;
    s[2] ^= s[0], s[3] ^= s[1], s[1] ^= s[2], s[0] ^= s[3], s[2] ^= t;
    s[3] = (s[3] << 45) | (s[3] >> 19);
    return result;
}

static inline double uniform(uint64_t *s) { return ((double)(next(s) >> 11) + 0.5) * 0x1p-53; }

static double normal(uint64_t *s)
{
    for (;;) {
        uint64_t word = next(s);
        int i = word & 255;
        double u = (double)((int64_t)word >> 11) * 0x1p-52, x = u * edge[i];
        if (__builtin_expect(fabs(u) < share[i], 1)) return x;
        if (i == 0) {
            double beyond, y;
            do beyond = -log(uniform(s)) / edge[1], y = -log(uniform(s));
            while (2 * y < beyond * beyond);
            return u < 0 ? -edge[1] - beyond : edge[1] + beyond;
        }
        double top = bell(edge[i]), low = bell(edge[i + 1]);
        if (top + uniform(s) * (low - top) < bell(x)) return x;
    }
}

/* Eight rows and a transposition cost half of what gathers do. */
static inline void look_up(const Law *law, const double *rows, real z, real *v0)
{
    real u = (smaller(larger(z, all(law->low)), all(law->high)) - law->low) * law->per_step, c[6];
    mask at = __builtin_convertvector(smaller(u, all(law->last)), mask);
    u -= __builtin_convertvector(at, real);
#if W == 8
    __m512d pair[2][4], four[2][4];
    for (int i = 0; i < 4; i++) {
        __m512d even = _mm512_loadu_pd(rows + 8 * at[2 * i]);
        __m512d odd = _mm512_loadu_pd(rows + 8 * at[2 * i + 1]);
        pair[0][i] = _mm512_unpacklo_pd(even, odd), pair[1][i] = _mm512_unpackhi_pd(even, odd);
    }
    for (int k = 0; k < 2; k++) {
        for (int i = 0; i < 2; i++) {
            four[0][i] = _mm512_shuffle_f64x2(pair[k][2 * i], pair[k][2 * i + 1], 0x44);
            four[1][i] = _mm512_shuffle_f64x2(pair[k][2 * i], pair[k][2 * i + 1], 0xee);
        }
        c[k] = _mm512_shuffle_f64x2(four[0][0], four[0][1], 0x88);
        c[2 + k] = _mm512_shuffle_f64x2(four[0][0], four[0][1], 0xdd);
        c[4 + k] = _mm512_shuffle_f64x2(four[1][0], four[1][1], 0x88);
    }
#else
    for (int j = 0; j < 6; j++) LANES c[j][i] = rows[8 * at[i] + j];
#endif
    for (int j = 0; j < 3; j++) v0[j] = c[2 * j] + u * c[2 * j + 1];
}

enum { QUIET, VECTOR, SCALAR };
enum { BATCH = 4 };   /* samples whose noise is drawn together */

static inline void draw_noise(int source, Stream *vector, Walk *scalar, real *noise)
{
    if (source == VECTOR) {
        for (int j = 0; j < 5 * BATCH; j += 4) {
            singles pair[2];
            narrow each[4];
            normals(vector, pair);
            memcpy(each, pair, sizeof each);
            for (int i = 0; i < 4; i++) noise[j + i] = __builtin_convertvector(each[i], real);
        }
    } else {
        for (int j = 0; j < 5 * BATCH; j++) LANES noise[j][i] = normal(scalar[i].s);
    }
}

/* machine: five rows of Body, three of Forces, `count` apart. start: ten states, then v0 of y1 y2 z. Errors count up to
 * and with the sample of a touchdown. */
static void group(const Machine *c, const Law *law, const double *rows, const double *machine, int64_t count,
                  const double *start, int64_t samples, const double *p_ref, const double *feed, int source,
                  Stream vector, const double *deviation, double *largest, uint8_t *touched)
{
    const real zero = {0}, Ts = all(law->Ts);
    real given[8], x[13], most[5] = {zero, zero, zero, zero, zero}, noise[5 * BATCH];
    for (int j = 0; j < 8; j++) memcpy(given + j, machine + j * count, sizeof(real));
    for (int j = 0; j < 13; j++) x[j] = all(start[j]);
    const Body body = {given[0], given[1], given[2], given[3], given[4]};
    const Forces to = {given[5], given[6], given[7]};
    Mover s;
    for (int i = 0; i < AXES; i++) s.q[i] = x[i], s.r[i] = x[5 + i] * (law->Ts / c->substeps);
    s.f[FX] = s.f[TY] = zero;
    s.f[FY] = to.to_sum * (x[10] + x[11]), s.f[TX] = to.to_moment * (x[11] - x[10]);
    s.f[FZ] = to.to_thrust * x[12];
    RadialMemory mx = {{x[X], x[BETA], x[5 + X], x[5 + BETA]}, {zero, zero}, {Ts, Ts}};
    RadialMemory my = {{x[Y], x[ALPHA], x[5 + Y], x[5 + ALPHA]}, {zero, zero}, {Ts, Ts}};
    AxialMemory mz = {{x[Z], x[5 + Z]}, zero, Ts};
    s.alpha = trig(x[ALPHA]), s.beta = trig(x[BETA]);
    mask flying = zero == zero;
    Walk scalar[W];
    for (int j = 0; j < 4; j++) LANES scalar[i].s[j] = vector.s[j][i];

    for (int64_t k = 0; k < samples; k++, p_ref += 5, feed += 5) {
        real p[5], v0[3], command[AXES];
        measure(c, &s, p);
        for (int j = 0; j < 5; j++) most[j] = larger((real)((mask)magnitude(p[j] - p_ref[j]) & flying), most[j]);
        flying &= (p[0] * p[0] + p[1] * p[1] < c->r_max2) & (p[2] * p[2] + p[3] * p[3] < c->r_max2);
        if (source != QUIET) {
            if (k % BATCH == 0) draw_noise(source, &vector, scalar, noise);
            for (int j = 0; j < 5; j++) p[j] += deviation[j] * noise[k % BATCH * 5 + j];
        }
        look_up(law, rows, p[4], v0);
        control(law, &mx, &my, &mz, p, p_ref, feed, v0, &to, command);
        advance(c, &body, command, &s);
    }
    for (int j = 0; j < 5; j++) memcpy(largest + j * count, most + j, sizeof(real));
    LANES touched[i] = !flying[i];
}

int width(void) { return W; }

/* machines: eight rows of count, a multiple of W. largest: five rows of count. */
void many(const Machine *c, const Law *law, const double *rows, const double *machines, int64_t count,
          const double *start, int64_t samples, const double *p_ref, const double *feed, int source, uint64_t seed,
          const double *deviation, double *largest, uint8_t *touched)
{
    build_ziggurat();
#pragma omp parallel for schedule(dynamic)
    for (int64_t i = 0; i < count; i += W)
        group(c, law, rows, machines + i, count, start, samples, p_ref, feed, source, stream(seed, (uint64_t)i),
              deviation, largest + i, touched + i);
}
