/* Mover and control law as malta states them, on `real`: a double, or a vector of doubles, one lane a machine.
 *
 * tubular.py and rigidbody.py with their trigonometry, all twelve states and their order; controller.py with its
 * matrices as loops, over (x, beta), (y, alpha) and z, between which they are zero. `sine` and `cosine` are the includer's. */
typedef struct {
    real inv_m, K_A2, moment, gain_B, gain_D; /* 1 / m, 2 K_A, 2 K_A l_B^2, what a newton of the law makes */
    real inv_I, ratio, l_B, l_S, wave, phase, cogging, g, decay, h, r_max2, z_max;
} Machine;
typedef struct { double L[10][5], Cd[5][10], Ad[10][10], Bd[10][5], K[5][10], Ki[5][5], limit[5], Ts; } Law;

static const int BLOCKS = 3, STATES_OF[] = {4, 4, 2}, AXES_OF[] = {2, 2, 1};
static const int STATE[][4] = {{0, 4, 5, 9}, {1, 3, 6, 8}, {2, 7}}, AXIS[][2] = {{0, 2}, {1, 3}, {4}};
#define BLOCK for (int b = 0; b < BLOCKS; b++)
#define STATES(i) for (int i##_ = 0, i; i##_ < STATES_OF[b] && (i = STATE[b][i##_], 1); i##_++)
#define AXES(j) for (int j##_ = 0, j; j##_ < AXES_OF[b] && (j = AXIS[b][j##_], 1); j##_++)

/* s: x y z alpha beta gamma and their rates; f: fx1 fy1 fx2 fy2 fz. */
static inline void rate(const Machine *c, const real *s, const real *f, real *d)
{
    real sa = sine(s[3]), ca = cosine(s[3]), sb = sine(s[4]), cb = cosine(s[4]), z = s[2];
    real n0 = sb, n1 = -cb * sa, pull0 = c->K_A2 * (s[0] - z * n0), pull1 = c->K_A2 * (s[1] - z * n1);
    real Fx = f[0] + f[2] + pull0, Fy = f[1] + f[3] + pull1;
    real Fz = f[4] - (pull0 * n0 + pull1 * n1) + c->cogging * wave_sine(c->wave * z + c->phase);
    real Mx = c->l_B * (f[2] - f[0]) + c->moment * n0 - z * Fx;
    real My = c->l_B * (f[3] - f[1]) + c->moment * n1 - z * Fy, Mz = -z * f[4];
    real T1 = -(ca * My + sa * Mz), T2 = cb * Mx - sb * (ca * Mz - sa * My);
    real da = s[9], db = s[10], turn = sb * da, omega = cb * da, lean = c->ratio * (turn + s[11]) - turn;
    for (int i = 0; i < 6; i++) d[i] = s[6 + i];
    d[6] = Fx * c->inv_m, d[7] = Fy * c->inv_m - c->g, d[8] = Fz * c->inv_m;
    d[9] = (T1 * c->inv_I - db * (lean - turn)) / cb, d[10] = T2 * c->inv_I + omega * lean;
    d[11] = -omega * db - sb * d[9];
}

static inline void measure(const Machine *c, const real *s, real *p)
{
    real ca = cosine(s[3]), sx = sine(s[4]) / (ca * cosine(s[4])), sy = -sine(s[3]) / ca;
    p[0] = s[0] - (c->l_S + s[2]) * sx, p[1] = s[1] - (c->l_S + s[2]) * sy;
    p[2] = s[0] + (c->l_S - s[2]) * sx, p[3] = s[1] + (c->l_S - s[2]) * sy, p[4] = s[2];
}

/* One sample of the law from y; xi, e and frozen move on. */
static inline void decide(const Law *law, const real *y, const real *v0, const double *p_ref, const double *xi_ref,
                          const double *v_ff, real *xi, real *e, real *frozen, real *v)
{
    BLOCK {
        real hat[10], innovation[5], u[5];
        AXES(j) {
            e[j] += law->Ts * (1 - frozen[j]) * (p_ref[j] - y[j]);
            innovation[j] = y[j];
            STATES(i) innovation[j] -= law->Cd[j][i] * xi[i];
        }
        STATES(i) {
            hat[i] = xi[i];
            AXES(j) hat[i] += law->L[i][j] * innovation[j];
        }
        AXES(j) {
            real wanted = v_ff[j] + v0[j];
            STATES(i) wanted += law->K[j][i] * (xi_ref[i] - hat[i]);
            AXES(i) wanted += law->Ki[j][i] * e[i];
            v[j] = clamp(wanted, law->limit[j]), frozen[j] = differ(v[j], wanted), u[j] = v[j] - v0[j];
        }
        STATES(i) {
            xi[i] = hat[i] * law->Ad[i][i];
            STATES(k) if (k != i) xi[i] += law->Ad[i][k] * hat[k];
            AXES(j) xi[i] += law->Bd[i][j] * u[j];
        }
    }
}

/* One sample of the mover: Runge–Kutta steps under the commands v, which the forces follow as exact lags. */
static inline void advance(const Machine *c, long substeps, const real *v, real *s, real *f)
{
    for (long n = 0; n < substeps; n++) {
        real k1[12], k2[12], k3[12], k4[12], mid[12], half[5], whole[5], h = c->h, h2 = c->h * 0.5, h6 = c->h * (1. / 6);
        for (int i = 0; i < 5; i++) half[i] = v[i] + c->decay * (f[i] - v[i]), whole[i] = v[i] + c->decay * (half[i] - v[i]);
        rate(c, s, f, k1);
        for (int i = 0; i < 12; i++) mid[i] = s[i] + h2 * k1[i];
        rate(c, mid, half, k2);
        for (int i = 0; i < 12; i++) mid[i] = s[i] + h2 * k2[i];
        rate(c, mid, half, k3);
        for (int i = 0; i < 12; i++) mid[i] = s[i] + h * k3[i];
        rate(c, mid, whole, k4);
        for (int i = 0; i < 12; i++) s[i] += h6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
        for (int i = 0; i < 5; i++) f[i] = whole[i];
    }
}
