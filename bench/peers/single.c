/* One stroke of one machine: true outputs and states of every sample. */
#include <math.h>

#define SHORT_CHAIN   /* one machine waits for latency, not for throughput */
typedef double real;
#include "loop.h"

static inline real clamp(real a, double limit) { a = a < limit ? a : limit; return a > -limit ? a : -limit; }
static inline real where_equal(real a, real b, double value) { return a == b ? value : 0; }

static inline real odd_flips(real a, real counter)   /* in a vector: no way through the integer registers */
{
    typedef double two __attribute__((vector_size(16)));
    typedef uint64_t words __attribute__((vector_size(16)));
    two value = {a, 0}, count = {counter, 0};
    return ((two)((words)value ^ ((words)count << 63)))[0];
}

static inline void look_up(const Law *law, const double *rows, double z, double *v0)
{
    z = z > law->low ? z : law->low;
    z = z < law->high ? z : law->high;
    double u = (z - law->low) * law->per_step;
    int i = (int)(u < law->last ? u : law->last);
    for (int j = 0; j < 3; j++) v0[j] = rows[8 * i + 2 * j] + (u - i) * rows[8 * i + 2 * j + 1];
}

/* start: the mover's twelve states. Stops at contact; returns the samples done. */
int64_t single(const Machine *c, const Law *law, const double *rows, const Body *body, const Forces *to,
               double omega_z, const double *start, int64_t samples, const double *p_ref, const double *feed,
               double *restrict p, double *restrict x)
{
    Mover s;
    double gamma = start[5], v0[3];
    const double h = law->Ts / c->substeps, per_second = 1 / h;
    for (int i = 0; i < AXES; i++) s.q[i] = start[i], s.r[i] = h * start[6 + i];
    s.alpha = trig(s.q[ALPHA]), s.beta = trig(s.q[BETA]);
    RadialMemory mx = {{s.q[X], s.q[BETA], start[6], start[10]}, {0}, {law->Ts, law->Ts}};
    RadialMemory my = {{s.q[Y], s.q[ALPHA], start[7], start[9]}, {0}, {law->Ts, law->Ts}};
    AxialMemory mz = {{s.q[Z], start[8]}, 0, law->Ts};
    look_up(law, rows, s.q[Z], v0);
    s.f[FX] = s.f[TY] = 0;
    s.f[FY] = to->to_sum * (v0[0] + v0[1]), s.f[TX] = to->to_moment * (v0[1] - v0[0]);
    s.f[FZ] = to->to_thrust * v0[2];
    for (int64_t k = 0; k < samples; k++, p += 5, x += 12, p_ref += 5, feed += 5) {
        double command[AXES];
        measure(c, &s, p);
        for (int i = 0; i < AXES; i++) x[i] = s.q[i], x[6 + i] = s.r[i] * per_second;
        x[5] = gamma, x[11] = omega_z - s.beta.sin * x[9];
        if (!(p[0] * p[0] + p[1] * p[1] < c->r_max2 && p[2] * p[2] + p[3] * p[3] < c->r_max2
              && fabs(p[4]) < c->z_max))
            return k + 1;
        look_up(law, rows, p[4], v0);
        control(law, &mx, &my, &mz, p, p_ref, feed, v0, to, command);
        gamma += law->Ts * omega_z - advance(c, body, command, &s);
    }
    return samples;
}
