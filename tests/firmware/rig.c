/* A supervised controller with its machine, and one fault or request that strikes it: all of it compiled C.

   rig.py compiles this with the controller `ctl`, its supervisor, and the machine `plant` of the same gain file. */
#include "ctl_supervisor.c"

#include <math.h>
#include <stddef.h>
#include <string.h>
#ifdef __SSE2__
#include <xmmintrin.h>
#endif

#define HELD (int)(sizeof(((ctl_outputs *)0)->COMMAND) / sizeof(ctl_real))
#define BEARINGS (int)(sizeof(((plant_readings *)0)->contact) / sizeof(double))
#if DRIVEN
#define READ (int)(sizeof(((ctl_inputs *)0)->i) / sizeof(ctl_real))
#endif

enum {
  NOTHING, LOST, STUCK, JUMP, DRIFT, NOISY, GAIN, CURRENT_BIAS, CURRENT_STUCK, CURRENT_FROZEN, CURRENT_GAIN,
  CURRENT_LOST, LINK, MISSED, HALF_BRIDGE, EXCITED, STO, BIT, BURST, PAIR_DRIFT, CURRENT_DRIFT, SAG, ASK_SINE, ASK_ACCELERATION, ASK_RAMP, ASK_STEP, ASK_RATE, ASK_TOGGLE, ASK_NAN
};

typedef struct {
  double start, operate, land; /* s, of requests */
  double stroke, rise, end;    /* a stroke back and forth from this moment on, each way in `rise`, to `end` */
} plan;

typedef struct {
  int kind;
  int place;   /* of a sensor, current or output; -1: all radial sensors, all currents */
  double size; /* of the reading's unit, or a share */
  double rate;
  double at, until; /* s */
} strike;

typedef struct {
  double radial, axial; /* m/s, the fastest contact since the strike; 0: none */
  double current;       /* A, the largest of an axis since the strike */
  double beyond;        /* s in a row that one was over its limit */
  double noticed, off;  /* s after the strike: the first row that acted, gates off; -1: never */
  int monitor;          /* the row's */
  int state;            /* at the end */
  int spoiled;       /* 1: an entry of a memory was no number */
} outcome;

typedef struct {
  ctl_state s;
  ctl_supervisor sup;
  ctl_request q;
  ctl_inputs in;
  ctl_outputs out;
  plant_state m;
  double before[3][16];
  double touched[16];
  int sample, missed, sum_acted;
  int over;
} world;

/* Mistakes of the wiring: which output a reading shows, times what, plus what; the same of currents and of half-bridges. */
static struct {
  int y[16], i[64], out[64];
  double gain[16], more[16], i_gain[64], out_gain[64];
} wires;

static int wired_so; /* 1: as set; 0: as it should be */

void rig_wire(const int *y, const double *gain, const double *more, const int *i, const double *i_gain, const int *out,
              const double *out_gain, const int *sizes) {
  wired_so = sizes[0] > 0;
  for (int k = 0; k < sizes[0]; k++) { wires.y[k] = y[k]; wires.gain[k] = gain[k]; wires.more[k] = more[k]; }
  for (int k = 0; k < sizes[1]; k++) { wires.i[k] = i[k]; wires.i_gain[k] = i_gain[k]; }
  for (int k = 0; k < sizes[2]; k++) { wires.out[k] = out[k]; wires.out_gain[k] = out_gain[k]; }
}

static const double par[] = { PARAMETERS, 0 };
#if NOISES
#define LOOK(m, noise, seed, r) plant_look(m, par, noise, seed, r)
#else
#define LOOK(m, noise, seed, r) plant_look(m, par, r)
#endif
#if WRENCH && DELAY
#define STEP(m, command, w) plant_step(m, par, command, 1, w, 1)
#elif WRENCH
#define STEP(m, command, w) plant_step(m, par, command, 1, w)
#elif DELAY
#define STEP(m, command, w) plant_step(m, par, command, 1, 1)
#else
#define STEP(m, command, w) plant_step(m, par, command, 1)
#endif
static const double most_current[] = { CURRENT_LIMITS };

size_t rig_bytes(void) { return sizeof(world); }

/* Where a member of the supervisor is. */
void *rig_member(world *w, int number) {
  static const size_t places[] = { MEMBERS };
  return (char *)&w->sup + places[number];
}

/* A machine that rests at x without current; its supervisor is off. */
void rig_rest(world *w, const double *x) {
  memset(w, 0, sizeof *w);
  ctl_init(&w->s);
  ctl_supervisor_init(&w->sup);
#if DRIVEN
  double volts[sizeof(w->s.u_integral) / sizeof(ctl_real)];
  plant_start(&w->m, par, x, 1.0, volts);
#else
  plant_start(&w->m, par, x, 1.0);
#endif
  for (int k = 0; k < BEARINGS; k++) { w->touched[k] = 1.0; }
}

/* A machine that flies at x from the start, held by its currents, with its reference there. */
void rig_fly_at(world *w, const double *x, const double *rest) {
  plant_readings r;
  rig_rest(w, x);
#if DRIVEN
  double volts[sizeof(w->s.u_integral) / sizeof(ctl_real)];
  plant_start(&w->m, par, x, 0.0, volts);
#else
  plant_start(&w->m, par, x, 0.0);
#endif
  LOOK(&w->m, 0.0, 1.0, &r);
  for (int k = 0; k < OUTPUTS; k++) { w->s.reference.p[k] = r.p[k]; }
  ctl_start(&w->s);
  ctl_supervisor_take_over(&w->sup, rest);
}

/* A number from -1 to 1 of a sample's reading: noise of sensors whose machine has none of its own. */
static double uniform(int sample, int k, double seed) {
  uint64_t x = ((uint64_t)sample * 64u + (uint64_t)k + 1u) * 0x9e3779b97f4a7c15u + (uint64_t)seed;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
  return (double)((x ^ (x >> 31)) >> 11) * 0x1p-52 - 1.0;
}

static void ask(const plan *p, const strike *f, double t, world *w) {
  ctl_request *q = &w->q;
  memset(q, 0, sizeof *q);
  q->start = (t >= p->start) && (t < p->start + 0.01);
  q->operate = t >= p->operate;
  q->land = t >= p->land;
  q->missed = w->missed;
#if STROKE >= 0
  if (t >= p->stroke) {
    const double whole = (t - p->stroke) / p->rise;
    const double turn = floor(whole), u = whole - turn;
    const int back = ((long)turn) % 2;
    const double T = p->rise, A = back ? -p->end : p->end;
    q->reference.p[STROKE] = (back ? p->end : 0) + A * (u * u * u * (10 - u * (15 - 6 * u)));
    q->reference.dp[STROKE] = A / T * (30 * u * u * (1 - u) * (1 - u));
    q->reference.ddp[STROKE] = A / (T * T) * (60 * u * (1 - u) * (1 - 2 * u));
  }
#endif
  if ((f->kind >= ASK_SINE) && (t >= f->at) && (t < f->until)) {
    const double u = t - f->at, a = 2 * M_PI * f->rate;
    double *p0 = &q->reference.p[f->place], *p1 = &q->reference.dp[f->place], *p2 = &q->reference.ddp[f->place];
    switch (f->kind) {
    case ASK_SINE: *p0 = f->size * sin(a * u); *p1 = f->size * a * cos(a * u); *p2 = -f->size * a * a * sin(a * u); break;
    case ASK_ACCELERATION: *p0 = f->rate + f->size * u * u / 2; *p1 = f->size * u; *p2 = f->size; break;
    case ASK_RAMP: *p0 = copysign(fmin(fabs(f->rate) * u, fabs(f->size)), f->size); *p1 = 0; *p2 = 0; break;
    case ASK_STEP: *p0 = f->size; *p1 = 0; *p2 = 0; break;
    case ASK_TOGGLE: *p0 = (((long)(u * f->rate)) % 2) ? -f->size : f->size; *p1 = 0; *p2 = 0; break;
    case ASK_RATE: *p0 = 0; *p1 = f->size; *p2 = f->rate; break;
    default: *p0 = NAN; break;
    }
  }
  if ((f->kind == STO) && (t >= f->at)) { q->sto = 1; }
}

static int is_at(const strike *f, int k, int all) { return (f->place == k) || ((f->place < 0) && all); }

static void spoil(const strike *f, double t, world *w, const double *p, double *held) {
  ctl_inputs *in = &w->in;
  if ((t < f->at) || (t >= f->until)) { return; }
  for (int k = 0; k < OUTPUTS; k++) {
    const int pair = (f->kind == PAIR_DRIFT) && (k == (f->place + 2) % 4); /* of the other plane */
    if (!is_at(f, k, k != STROKE) && !pair) { continue; }
    const double y = in->y[k];
    switch (f->kind) {
    case LOST: in->y[k] = NAN; break;
    case STUCK: if (isnan(held[k])) { held[k] = y; } in->y[k] = held[k]; break;
    case JUMP: in->y[k] = y + f->size; break;
    case DRIFT: in->y[k] = y + (f->size * (t - f->at)); break;
    case NOISY: in->y[k] = y + ((w->sample % 2) ? f->size : -f->size); break;
    case GAIN: in->y[k] = y + ((f->size - 1) * p[k]); break;
    case BIT: in->y[k] = y + ((((long)floor(y / f->size)) % 2) ? 0 : f->size); break;
    case BURST: if (((w->sample * 2654435761u) >> 8) % 1000u < 1000 * f->size) { in->y[k] = NAN; } break;
    case PAIR_DRIFT: in->y[k] = y + ((pair ? f->rate : f->size) * (t - f->at)); break;
    default: break;
    }
  }
#if DRIVEN
  for (int k = 0; k < READ; k++) {
    if (!is_at(f, k, 1)) { continue; }
    switch (f->kind) {
    case CURRENT_BIAS: in->i[k] = in->i[k] + f->size; break;
    case CURRENT_STUCK: in->i[k] = f->size; break;
    case CURRENT_FROZEN: if (isnan(held[k])) { held[k] = in->i[k]; } in->i[k] = held[k]; break;
    case CURRENT_GAIN: in->i[k] = in->i[k] * f->size; break;
    case CURRENT_LOST: in->i[k] = NAN; break;
    case CURRENT_DRIFT: in->i[k] = in->i[k] * (1 + (f->size * (t - f->at))); break;
    default: break;
    }
  }
  if (f->kind == LINK) { in->link[0] = in->link[0] * f->size; }
  if (f->kind == SAG) { in->link[0] = in->link[0] * fmax(f->size, 1 - (f->rate * (t - f->at))); }
#endif
#if EXCITATION
  if (f->kind == EXCITED) { in->excitation[f->place] = f->size; }
#endif
}

/* Numbers that a supervisor remembers: all of them finite. */
static int is_sane(const ctl_supervisor *sup) {
  const double *list[] = { REALS };
  const int sizes[] = { REAL_SIZES };
  for (unsigned j = 0; j < sizeof sizes / sizeof sizes[0]; j++) {
    for (int k = 0; k < sizes[j]; k++) {
      if (!isfinite(list[j][k])) { return 0; }
    }
  }
  return 1;
}

static void measure(world *w, const plant_readings *r, const strike *f, double t, outcome *o) {
  for (int k = 0; k < BEARINGS; k++) {
    if ((r->contact[k] >= 1) && (w->touched[k] < 1) && (t > f->at)) {
      double speed = 0;
      for (int j = 0; j < OUTPUTS; j++) {
        if (SOFT ? (CUSHIONED[k] == (j != STROKE)) : (j < LENGTHS)) { speed = fmax(speed, fabs(r->p[j] - w->before[0][j]) / (3 * CTL_SAMPLE_TIME)); }
      }
      if (CUSHIONED[k]) { o->radial = fmax(o->radial, speed); } else { o->axial = fmax(o->axial, speed); }
    }
    w->touched[k] = r->contact[k];
  }
  memcpy(w->before[0], w->before[1], 2 * sizeof w->before[0]);
  memcpy(w->before[2], r->p, sizeof r->p);
#if DRIVEN
  double axes[sizeof most_current / sizeof(double)], p[OUTPUTS];
  memcpy(p, r->p, sizeof p);
  rig_axes(r->i, p, axes);
  int over = 0;
  for (unsigned k = 0; k < sizeof axes / sizeof axes[0]; k++) {
    if (t > f->at) { o->current = fmax(o->current, fabs(axes[k])); }
    over |= fabs(axes[k]) > 1.02 * most_current[k];
  }
  w->over = over ? w->over + 1 : 0;
  if (t > f->at) { o->beyond = fmax(o->beyond, w->over * CTL_SAMPLE_TIME); }
#endif
}

/* Fly to a moment. trace: rows of 2 + 5 OUTPUTS numbers (t, state, p, y, reference, rate, what the filter expects), one a sample; or none. */
void rig_fly(world *w, const plan *p, const strike *f, double noise, double seed, double until, outcome *o, double *trace) {
  double held[64];
  long lost = 0;
  for (int k = 0; k < 64; k++) { held[k] = NAN; }
#ifdef __SSE2__
  const unsigned mode = _mm_getcsr();
  _mm_setcsr(mode | 0x8040u); /* currents that decay are zero in the end: their last digits take ten times as long */
#endif
  o->noticed = o->off = -1;
  o->monitor = -1;
  o->radial = o->axial = o->current = o->beyond = 0;
  o->spoiled = 0;
  for (; w->sample * CTL_SAMPLE_TIME < until; w->sample++) {
    const double t = (w->sample + 1e-6) * CTL_SAMPLE_TIME;
    plant_readings r;
    double command[HELD];
    LOOK(&w->m, noise, seed, &r);
    measure(w, &r, f, t, o);
    if (o->axial > 0) { break; } /* no wall is there */
    if ((f->kind == MISSED) && (t >= f->at) && (lost < (long)f->size)) {
      lost++;
      w->missed++;
    } else {
      const int enabled = w->sup.enable;
      memset(&w->in, 0, sizeof w->in);
      for (int k = 0; k < OUTPUTS; k++) { w->in.y[k] = (ctl_real)(r.y[k] + noise * UNIFORM[k] * uniform(w->sample, k, seed)); w->in.y_valid[k] = 1; }
#if DRIVEN
      for (int k = 0; k < READ; k++) { w->in.i[k] = (ctl_real)r.i[k]; w->in.i_valid[k] = 1; }
      w->in.link[0] = (ctl_real)r.link[0];
#endif
      if (wired_so) { /* a reading of gain 0 is noise */
        for (int k = 0; k < OUTPUTS; k++) {
          const int from = wires.y[k];
          w->in.y[k] = (ctl_real)(wires.more[k] + (wires.gain[k] == 0 ? r.y[k] - r.p[k] : wires.gain[k] * r.y[from]));
        }
#if DRIVEN
        for (int k = 0; k < READ; k++) { w->in.i[k] = (ctl_real)(wires.i_gain[k] * r.i[wires.i[k]]); }
#endif
      }
      spoil(f, t, w, r.p, held);
      ask(p, f, t, w);
      w->missed = 0;
      if (trace) {
        ctl_real expected[OUTPUTS];
        expect(&w->sup, &w->s, &w->in, expected);
        for (int k = 0; k < OUTPUTS; k++) { trace[(long)w->sample * (2 + 5 * OUTPUTS) + 2 + 4 * OUTPUTS + k] = expected[k]; }
      }
      ctl_supervisor_step(&w->sup, &w->s, &w->in, &w->q, &w->out);
      int sum = 0;
      for (int k = 0; k < CTL_MONITOR_ROWS; k++) { sum += w->sup.acted[k]; }
      if ((t >= f->at) && (sum > w->sum_acted) && (o->noticed < 0)) {
        o->noticed = t - f->at;
        o->monitor = w->sup.monitor;
      }
      w->sum_acted = sum;
      if ((t >= f->at) && enabled && !w->sup.enable && (o->off < 0)) { o->off = t - f->at; }
      if (!is_sane(&w->sup)) { o->spoiled = 1; }
    }
    for (int k = 0; k < HELD; k++) {
      const double zero = DRIVEN ? 0.5 : 0.0; /* of half-bridges */
      command[k] = wired_so ? zero + (wires.out_gain[k] * (w->out.COMMAND[wires.out[k]] - zero)) : w->out.COMMAND[k];
    }
    if ((f->kind == HALF_BRIDGE) && (t >= f->at) && (t < f->until) && w->sup.enable) { command[f->place] = f->size; }
    if (trace) {
      double *row = trace + (long)w->sample * (2 + 5 * OUTPUTS);
      row[0] = t;
      row[1] = w->sup.state;
      for (int k = 0; k < OUTPUTS; k++) {
        row[2 + k] = r.p[k];
        row[2 + OUTPUTS + k] = w->in.y[k];
        row[2 + 2 * OUTPUTS + k] = w->s.reference.p[k];
        row[2 + 3 * OUTPUTS + k] = w->s.reference.dp[k];
      }
    }
#if WRENCH
    const double none[WRENCH] = { 0 };
    STEP(&w->m, command, none);
#else
    STEP(&w->m, command, NULL);
#endif
  }
#ifdef __SSE2__
  _mm_setcsr(mode);
#endif
  o->state = w->sup.state;
}
