/* One stroke of one machine, the same equations as malta's, written down as one writes them. */
#include <math.h>

typedef double real;
#define sine sin
#define cosine cos
#define wave_sine sin
static inline real clamp(real a, double limit) { return fmax(fmin(a, limit), -limit); }
static inline real differ(real a, real b) { return a != b; }
#include "plain.h"

/* Returns the samples done; x is k x 12, p k x 5. grid: rows of z, v0 and slope. state: mover, forces, xi. */
long plain(const Machine *c, const Law *law, long points, const double *grid, long samples, long substeps,
           const double *p_ref, const double *xi_ref, const double *v_ff, const double *state, double *p, double *x)
{
    double s[12], f[5], xi[10], e[5] = {0}, frozen[5] = {0};
    for (int i = 0; i < 12; i++) s[i] = state[i];
    for (int i = 0; i < 5; i++) f[i] = state[12 + i];
    for (int i = 0; i < 10; i++) xi[i] = state[17 + i];
    for (long k = 0; k < samples; k++, p += 5, x += 12, p_ref += 5, xi_ref += 10, v_ff += 5) {
        double v0[5], v[5];
        measure(c, s, p);
        for (int i = 0; i < 12; i++) x[i] = s[i];
        if (!(p[0] * p[0] + p[1] * p[1] < c->r_max2 && p[2] * p[2] + p[3] * p[3] < c->r_max2 && fabs(p[4]) < c->z_max))
            return k + 1;
        long low = 0, high = points - 1; /* bisection */
        while (high - low > 1) {
            long middle = (low + high) / 2;
            if (p[4] >= grid[11 * middle]) low = middle;
            else high = middle;
        }
        for (int i = 0; i < 5; i++) v0[i] = grid[11 * low + 1 + i] + (p[4] - grid[11 * low]) * grid[11 * low + 6 + i];
        decide(law, p, v0, p_ref, xi_ref, v_ff, xi, e, frozen, v);
        for (int i = 0; i < 5; i++) v[i] *= i < 4 ? c->gain_B : c->gain_D;
        advance(c, substeps, v, s, f);
    }
    return samples;
}
