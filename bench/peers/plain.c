/* One stroke of one machine, the same equations as malta's, written down as one writes them: matrices as loops. */
#include <math.h>

typedef struct {
    double m, I_xx, I_yy, I_zz, K_A, l_B, l_S, wave, phi_c, F_c, g, r_max, z_max, decay, h;
} Machine;
typedef struct {
    double L[10][5], Cd[5][10], Ad[10][10], Bd[10][5], K[5][10], Ki[5][5], limit[5], Ts;
} Law;

static inline void rate(const Machine *c, const double *s, const double *f, double *d)
{
    double sa = sin(s[3]), ca = cos(s[3]), sb = sin(s[4]), cb = cos(s[4]);
    double n0 = sb, n1 = -sa * cb, l1 = -(c->l_B + s[2]), l2 = c->l_B - s[2];
    double a1x = c->K_A * (s[0] + l1 * n0), a1y = c->K_A * (s[1] + l1 * n1);
    double a2x = c->K_A * (s[0] + l2 * n0), a2y = c->K_A * (s[1] + l2 * n1);
    double F1x = f[0] + a1x, F1y = f[1] + a1y, F2x = f[2] + a2x, F2y = f[3] + a2y;
    double Fz = f[4] - (a1x + a2x) * n0 - (a1y + a2y) * n1 + c->F_c * sin(c->wave * s[2] + c->phi_c);
    double mx = l1 * F1x + l2 * F2x, my = l1 * F1y + l2 * F2y, mz = (l1 + l2) * f[4] / 2;
    double Tx = -(ca * my + sa * mz), Ty = cb * mx + sa * sb * my - ca * sb * mz; /* in the frame before gamma */
    double da = s[9], db = s[10], w3 = sb * da + s[11], w1 = cb * da, turn = sb * da;
    double ex = (Tx - (c->I_zz * w3 - c->I_yy * turn) * db) / c->I_xx;
    double ey = (Ty - (c->I_xx * turn - c->I_zz * w3) * w1) / c->I_yy;
    for (int i = 0; i < 6; i++) d[i] = s[6 + i];
    d[6] = (F1x + F2x) / c->m, d[7] = (F1y + F2y) / c->m - c->g, d[8] = Fz / c->m;
    d[9] = (ex + sb * da * db) / cb, d[10] = ey, d[11] = -w1 * db - sb * d[9];
}

static inline void measure(const Machine *c, const double *s, double *p)
{
    double sx = sin(s[4]) / (cos(s[3]) * cos(s[4])), sy = -sin(s[3]) / cos(s[3]);
    p[0] = s[0] - (c->l_S + s[2]) * sx, p[1] = s[1] - (c->l_S + s[2]) * sy;
    p[2] = s[0] + (c->l_S - s[2]) * sx, p[3] = s[1] + (c->l_S - s[2]) * sy, p[4] = s[2];
}

/* Returns the samples done; x is k x 12, p k x 5. grid: rows of z, v0 and slope. */
long plain(const Machine *c, const Law *law, long points, const double *grid, long samples, long substeps,
           const double *p_ref, const double *xi_ref, const double *v_ff, double *state, double *p, double *x)
{
    double *s = state, *f = state + 12, *xi = state + 17, *e = state + 27, *frozen = state + 32;
    for (long k = 0; k < samples; k++, p += 5, x += 12, p_ref += 5, xi_ref += 10, v_ff += 5) {
        double hat[10], v0[5], v[5], next[10], k1[12], k2[12], k3[12], k4[12], mid[12], half[5], whole[5];
        measure(c, s, p);
        for (int i = 0; i < 12; i++) x[i] = s[i];
        if (hypot(p[0], p[1]) >= c->r_max || hypot(p[2], p[3]) >= c->r_max || fabs(p[4]) >= c->z_max) return k + 1;
        for (int i = 0; i < 5; i++) e[i] += law->Ts * (1 - frozen[i]) * (p_ref[i] - p[i]);
        for (int i = 0; i < 10; i++) hat[i] = xi[i];
        for (int j = 0; j < 5; j++) {
            double innovation = p[j];
            for (int i = 0; i < 10; i++) innovation -= law->Cd[j][i] * xi[i];
            for (int i = 0; i < 10; i++) hat[i] += law->L[i][j] * innovation;
        }
        long low = 0, high = points - 1; /* bisection */
        while (high - low > 1) {
            long middle = (low + high) / 2;
            if (p[4] >= grid[11 * middle]) low = middle;
            else high = middle;
        }
        for (int i = 0; i < 5; i++) {
            v0[i] = grid[11 * low + 1 + i] + (p[4] - grid[11 * low]) * grid[11 * low + 6 + i];
            double wanted = v_ff[i] + v0[i];
            for (int j = 0; j < 10; j++) wanted += law->K[i][j] * (xi_ref[j] - hat[j]);
            for (int j = 0; j < 5; j++) wanted += law->Ki[i][j] * e[j];
            v[i] = fmax(fmin(wanted, law->limit[i]), -law->limit[i]);
            frozen[i] = v[i] != wanted;
        }
        for (int i = 0; i < 10; i++) {
            next[i] = 0;
            for (int j = 0; j < 10; j++) next[i] += law->Ad[i][j] * hat[j];
            for (int j = 0; j < 5; j++) next[i] += law->Bd[i][j] * (v[j] - v0[j]);
        }
        for (int i = 0; i < 10; i++) xi[i] = next[i];
        for (long n = 0; n < substeps; n++) {
            double h = c->h;
            for (int i = 0; i < 5; i++) {
                half[i] = v[i] + c->decay * (f[i] - v[i]);
                whole[i] = v[i] + c->decay * (half[i] - v[i]);
            }
            rate(c, s, f, k1);
            for (int i = 0; i < 12; i++) mid[i] = s[i] + h / 2 * k1[i];
            rate(c, mid, half, k2);
            for (int i = 0; i < 12; i++) mid[i] = s[i] + h / 2 * k2[i];
            rate(c, mid, half, k3);
            for (int i = 0; i < 12; i++) mid[i] = s[i] + h * k3[i];
            rate(c, mid, whole, k4);
            for (int i = 0; i < 12; i++) s[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
            for (int i = 0; i < 5; i++) f[i] = whole[i];
        }
    }
    return samples;
}
