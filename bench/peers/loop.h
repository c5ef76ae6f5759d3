/* Mover and control law by hand, on `real`: a double, or a vector of doubles, one lane a plant.
 *
 * Left out because it is zero: the law's couplings between (x, beta), (y, alpha) and z, v0 of the x axis.
 * Used because the mover is symmetric (I_xx = I_yy): its spin omega_z is constant, gamma acts on nothing.
 * The modules' forces are carried as sum over mass and moment over inertia; the unit of the mover's time is a
 * Runge-Kutta step, which is written for q'' = a(q, q', t).
 */
#include <stdint.h>

enum { X, Y, Z, ALPHA, BETA, AXES };      /* of the mover; the law's outputs are x1 y1 x2 y2 z */
enum { FX, FY, TY, TX, FZ };              /* sums over m, moments over I, thrust over m */

typedef struct { double C[2][2], L[4][2], K[2][4], Ki[2][2], A[4][2], B[4][2], limit[2]; } Radial;
typedef struct { double C, L[2], K[2], Ki, A[3], B[2], limit; } Axial;
/* Of (x, beta), (y, alpha) and z, each with its rates; and the grid of v0(z), whose rows hold value and slope of y1,
 * y2, z, and two numbers of padding. */
typedef struct { Radial x, y; Axial z; double Ts, low, high, per_step, last; } Law;
typedef struct { double l_S, g, wave, phase, decay, r_max2, z_max, substeps; } Machine;   /* wave: 2 / L_p */

/* Of a plant: 2 K_A / m, 2 K_A l_B^2 / I, m / I, F_c / m, omega_z I_zz / I; and what a newton of the law is worth. */
typedef struct { real stiffness, tilt, lever, cogging, spin; } Body;
typedef struct { real to_sum, to_moment, to_thrust; } Forces;
typedef struct { real sin, cos, sec; } Trig;
typedef struct { real q[AXES], r[AXES], f[AXES]; Trig alpha, beta; } Mover;
typedef struct { real xi[4], e[2], gate[2]; } RadialMemory;           /* gate: Ts, or 0 after saturation */
typedef struct { real xi[2], e, gate; } AxialMemory;

static inline real clamp(real a, double limit);
static inline real where_equal(real a, real b, double value);   /* value, elsewhere 0 */
static inline real odd_flips(real a, real counter);             /* -a where the last bit of counter is set */

/* To the last bit within 0.01 rad, half as much again as the air gap allows: what is beyond has touched down. */
static inline Trig trig(real a)
{
    real t = a * a, w = t * (-1. / 2 + t * (1. / 24 + t * (-1. / 720)));
    return (Trig){.sin = a + a * t * (-1. / 6 + t * (1. / 120)), .cos = 1 + w, .sec = 1 - w * (1 - w * (1 - w))};
}

/* sin(pi u), |u| < 2^50: an odd polynomial (error 4e-16) between the zeros, the sign by the zero's parity. */
static inline real sin_pi(real u)
{
    const double shift = 0x1.8p52;
    real near = u + shift, r = u - (near - shift), t = r * r;
    double k[] = {3.1415926535897927, -5.167712780049786, 2.550164039861884, -0.5992645288256148,
                  0.08214587882077493, -0.007370364352718201, 0.0004659870919775173, -2.1133714397960184e-05};
#ifdef SHORT_CHAIN
    real t2 = t * t;
    real s = k[0] + t * k[1] + t2 * (k[2] + t * k[3]) + t2 * t2 * (k[4] + t * k[5] + t2 * (k[6] + t * k[7]));
#else
    real s = k[0] + t * (k[1] + t * (k[2] + t * (k[3] + t * (k[4] + t * (k[5] + t * (k[6] + t * k[7]))))));
#endif
    return odd_flips(r * s, near);
}

static inline void accelerate(const Machine *c, const Body *b, const real *f, const real *q, Trig al, Trig be,
                              real da, real db, real *a, real *turn)
{
    real z = q[Z], n0 = be.sin, n1 = -(be.cos * al.sin);
    real kx = b->stiffness * (q[X] - z * n0), ky = b->stiffness * (q[Y] - z * n1);
    real Fx = f[FX] + kx, Fy = f[FY] + ky, arm = b->lever * z;
    real mx = f[TY] + b->tilt * n0 - arm * Fx, my = f[TX] + b->tilt * n1 - arm * Fy, mz = arm * f[FZ];
    a[X] = Fx;
    a[Y] = Fy - c->g;
    a[Z] = f[FZ] + b->cogging * sin_pi(z * c->wave + c->phase) - kx * n0 - ky * n1;
    *turn = be.sin * da;
    real lean = b->spin - *turn;
    a[ALPHA] = (al.sin * mz - al.cos * my - db * (lean - *turn)) * be.sec;
    a[BETA] = be.cos * (mx + da * lean) + be.sin * (al.sin * my + al.cos * mz);
}

/* One sample, the commands held: forces follow them exactly, the mover in Runge-Kutta steps. Returns the integral of
 * sin(beta) alpha', by which gamma lags behind the spin. */
static inline real advance(const Machine *c, const Body *b, const real *command, Mover *s)
{
    real held[AXES], half[AXES], whole[AXES], q[AXES], a1[AXES], a2[AXES], a3[AXES], a4[AXES];
    real turn1, turn2, turn3, turn4, turned = {0};
    for (int i = 0; i < AXES; i++) held[i] = (1 - c->decay) * command[i];
    for (int step = 0; step < (int)c->substeps; step++) {
        for (int i = 0; i < AXES; i++) {
            half[i] = held[i] + c->decay * s->f[i];
            whole[i] = held[i] + c->decay * half[i];
        }
        real da = s->r[ALPHA], db = s->r[BETA];
        accelerate(c, b, s->f, s->q, s->alpha, s->beta, da, db, a1, &turn1);
        for (int i = 0; i < AXES; i++) q[i] = s->q[i] + s->r[i] / 2;
        accelerate(c, b, half, q, trig(q[ALPHA]), trig(q[BETA]), da + a1[ALPHA] / 2, db + a1[BETA] / 2, a2, &turn2);
        for (int i = 0; i < AXES; i++) q[i] += a1[i] / 4;
        accelerate(c, b, half, q, trig(q[ALPHA]), trig(q[BETA]), da + a2[ALPHA] / 2, db + a2[BETA] / 2, a3, &turn3);
        for (int i = 0; i < AXES; i++) {
            s->q[i] += s->r[i];
            q[i] = s->q[i] + a2[i] / 2;
        }
        accelerate(c, b, whole, q, trig(q[ALPHA]), trig(q[BETA]), da + a3[ALPHA], db + a3[BETA], a4, &turn4);
        for (int i = 0; i < AXES; i++) {
            real middle = a2[i] + a3[i], early = a1[i] + middle;
            s->q[i] += early * (1. / 6);
            s->r[i] += (early + (middle + a4[i])) * (1. / 6);
            s->f[i] = whole[i];
        }
        s->alpha = trig(s->q[ALPHA]), s->beta = trig(s->q[BETA]);
        turned += (turn1 + turn4 + 2 * (turn2 + turn3)) * (1. / 6);
    }
    return turned;
}

/* Where the mover's axis pierces the sensor planes. */
static inline void measure(const Machine *c, const Mover *s, real *p)
{
    real sec = s->alpha.sec, below = c->l_S + s->q[Z], above = c->l_S - s->q[Z];
    real tilt_x = s->beta.sin * s->beta.sec * sec, tilt_y = -(s->alpha.sin * sec);
    p[0] = s->q[X] - below * tilt_x, p[1] = s->q[Y] - below * tilt_y;
    p[2] = s->q[X] + above * tilt_x, p[3] = s->q[Y] + above * tilt_y;
    p[4] = s->q[Z];
}

/* feed: K xi* + v_ff; v0 may be null. Returns the commands v. */
static inline void radial(const Radial *g, double Ts, RadialMemory *s, const real *y, const double *p_ref,
                          const double *feed, const real *v0, real *v)
{
    real i0 = y[0] - g->C[0][0] * s->xi[0] - g->C[0][1] * s->xi[1];
    real i1 = y[1] - g->C[1][0] * s->xi[0] - g->C[1][1] * s->xi[1];
    real hat[4], u[2];
    for (int j = 0; j < 4; j++) hat[j] = s->xi[j] + g->L[j][0] * i0 + g->L[j][1] * i1;
    for (int j = 0; j < 2; j++) s->e[j] += s->gate[j] * (p_ref[2 * j] - y[j]);
    for (int j = 0; j < 2; j++) {
        u[j] = feed[2 * j] + g->Ki[j][0] * s->e[0] + g->Ki[j][1] * s->e[1];
        u[j] -= g->K[j][0] * hat[0] + g->K[j][1] * hat[1] + g->K[j][2] * hat[2] + g->K[j][3] * hat[3];
        real wanted = v0 ? u[j] + v0[j] : u[j];
        v[j] = clamp(wanted, g->limit[j]);
        s->gate[j] = where_equal(v[j], wanted, Ts);
        u[j] = v0 ? v[j] - v0[j] : v[j];
    }
    for (int j = 0; j < 4; j++)
        s->xi[j] = g->A[j][0] * hat[j % 2] + g->A[j][1] * hat[j % 2 + 2] + g->B[j][0] * u[0] + g->B[j][1] * u[1];
}

static inline real axial(const Axial *g, double Ts, AxialMemory *s, real y, double p_ref, double feed, real v0)
{
    real i = y - g->C * s->xi[0], z = s->xi[0] + g->L[0] * i, dz = s->xi[1] + g->L[1] * i;
    s->e += s->gate * (p_ref - y);
    real wanted = feed + g->Ki * s->e - g->K[0] * z - g->K[1] * dz + v0;
    real v = clamp(wanted, g->limit), u = v - v0;
    s->gate = where_equal(v, wanted, Ts);
    s->xi[0] = g->A[0] * z + g->A[1] * dz + g->B[0] * u;
    s->xi[1] = g->A[2] * dz + g->B[1] * u;
    return v;
}

/* One sample of the law: measured y to what the forces head for. v0: y1 y2 z. */
static inline void control(const Law *law, RadialMemory *mx, RadialMemory *my, AxialMemory *mz, const real *y,
                           const double *p_ref, const double *feed, const real *v0, const Forces *to, real *command)
{
    real v_x[2], v_y[2], y_x[2] = {y[0], y[2]}, y_y[2] = {y[1], y[3]};
    radial(&law->x, law->Ts, mx, y_x, p_ref, feed, 0, v_x);
    radial(&law->y, law->Ts, my, y_y, p_ref + 1, feed + 1, v0, v_y);
    command[FX] = to->to_sum * (v_x[0] + v_x[1]), command[TY] = to->to_moment * (v_x[1] - v_x[0]);
    command[FY] = to->to_sum * (v_y[0] + v_y[1]), command[TX] = to->to_moment * (v_y[1] - v_y[0]);
    command[FZ] = to->to_thrust * axial(&law->z, law->Ts, mz, y[4], p_ref[4], feed[4], v0[2]);
}
