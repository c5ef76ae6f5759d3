/* The loop around one control period of machine and controller: the frame of every compiled engine.

   Before it stand the sizes as #defines, numbers.c, the functions `prepare`, `foresee`, `sense`, `decide`, `substep` and
   those of the digest, which engines.py generates from CasADi expressions, and noise.c. c, d and g are those of
   instructions.py. LANES machines run side by side, one in each lane of a SIMD register; with LANES 1 a `real` is a double and
   the rows of every sample are kept.                                                                                */

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
#if LANES == 8
#define EVEN 0, 8, 2, 10, 4, 12, 6, 14
#define ODD 1, 9, 3, 11, 5, 13, 7, 15
#define PAIRS 0, 1, 8, 9, 4, 5, 12, 13
#define OTHERS 2, 3, 10, 11, 6, 7, 14, 15
#define FRONT 0, 1, 2, 3, 8, 9, 10, 11
#define BACK 4, 5, 6, 7, 12, 13, 14, 15
static inline void transpose(real *row) {
  TURN(0, 1, EVEN, ODD) TURN(2, 3, EVEN, ODD) TURN(4, 5, EVEN, ODD) TURN(6, 7, EVEN, ODD)
  TURN(0, 2, PAIRS, OTHERS) TURN(1, 3, PAIRS, OTHERS) TURN(4, 6, PAIRS, OTHERS) TURN(5, 7, PAIRS, OTHERS)
  TURN(0, 4, FRONT, BACK) TURN(1, 5, FRONT, BACK) TURN(2, 6, FRONT, BACK) TURN(3, 7, FRONT, BACK)
}
#else /* 4 */
#define EVEN 0, 4, 2, 6
#define ODD 1, 5, 3, 7
#define FRONT 0, 1, 4, 5
#define BACK 2, 3, 6, 7
static inline void transpose(real *row) {
  TURN(0, 1, EVEN, ODD) TURN(2, 3, EVEN, ODD)
  TURN(0, 2, FRONT, BACK) TURN(1, 3, FRONT, BACK)
}
#endif
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
#define RARE __attribute__((noinline)) /* rare for a mover in its air gap, and all there is for a pendulum */
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
    if (!nowhere(MASK(range > NEAR))) return 0; /* mostly the first look tells */ \
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
SAMPLE(, RARE, )
#else
SAMPLE(, inline, )
#define control_near control
#define motion_near motion
#endif

#if LANES == 1
/* Rows of `samples` control periods from the one of number `first` on; `state` is taken and left behind. Where a sample is
   no whole number of substeps, it begins with the first substep after it. The first row that has 1 or more, or no number,
   in one of the `ends` columns is the last. Returns the number of rows.                                                */
long run(long first, long samples, double substeps, const double *theta, long points, const double *table, double *state,
         const double *given, const double *noise, const double *fast, double *rows, long ends, const long *ending) {
  double c[CONSTANTS + 1], d[SHARED + 1], g[FORESEEN + 1], held[HELD], m[2][STATES], *now = m[0], *after = m[1], *before;
  Grid grid = {points, 0, table};
  long done = (long)ceil((double)first * substeps - 1e-6), left = samples;
  prepare(theta, c, d);
  memcpy(now, state, sizeof *m);
  for (long k = first; left > 0; k++, left--, given += GIVEN, noise += OUTPUTS, rows += ROW) {
    const long end = (long)ceil((double)(k + 1) * substeps - 1e-6), count = end - done;
    foresee(d, given, g);
    int near = control_near(c, d, g, now, &grid, given, noise, after + MACHINE, held, rows);
    if (!near) control(c, d, g, now, &grid, given, noise, after + MACHINE, held, rows);
    if (!near || !motion_near(c, d, g, count, now, held, given, fast, after))
      motion(c, d, g, count, now, held, given, fast, after);
    before = now, now = after, after = before, done = end, fast += count * JITTER;
    for (long i = 0; i < ends; i++)
      if (!(rows[ending[i]] < 1)) samples -= left - 1, left = 1;
  }
  memcpy(state, now, sizeof *m);
  return samples;
}
#else
#if CRUISE
/* The digest after a sample in which something happens. */
static RARE void count(const real *c, const double *d, const double *g, real *kept, const real *row,
                       const double *given) {
  digest(c, d, g, kept, row, given, kept);
}
#endif
/* A sample by the general functions. */
static RARE void sample(const real *c, const double *d, const double *g, const real *now, Grid *grid, long substeps,
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

/* c and d of a group, from the numbers that all machines share and the `count` that are each machine's own, at `own`. */
static void prepare_group(const double *same, long count, const long *places, const double *own, real *c, double *d) {
  real t[THETA + 1];
  for (int k = 0; k < THETA; k++) t[k] = K(same[k]);
  for (long k = 0; k < count; k++) memcpy(t + places[k], own + k * LANES, sizeof *t);
  prepare(t, c, d);
}

/* g of all samples, from the numbers of any group; without a place for it, how many numbers a sample has. */
long foresee_all(long samples, const double *same, long count, const long *places, const double *own,
                 const double *given, double *g) {
  real c[CONSTANTS + 1];
  double d[SHARED + 1];
  if (!g) return FORESEEN;
  prepare_group(same, count, places, own, c, d);
  for (long k = 0; k < samples; k++) foresee(d, given + k * GIVEN, g + k * FORESEEN);
  return FORESEEN;
}

/* Groups of LANES machines, one after the other; states and digests are taken and left behind. g: of foresee_all. */
void run_many(long groups, long samples, long substeps, const double *same, long count, const long *places,
              const double *own, long points, const double *table, double *states, const double *given, const double *g,
              long uniform, const double *sigma, const uint64_t *keys, double *digests) {
  const size_t size = (size_t)(points * PADDED + LANES) * sizeof(double);
  double *rows = aligned_alloc(64, size), first = table[0];
  if (!rows) abort();
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
    real c[CONSTANTS + 1];
    prepare_group(same, count, places, own + i * count * LANES, c, d);
    run_group(samples, substeps, c, d, g, &grid, states + i * STATES * LANES, given, uniform,
              sigma + i * OUTPUTS * LANES, keys + i * LANES, digests + i * DIGEST * LANES);
  }
  free(rows);
}
#endif
