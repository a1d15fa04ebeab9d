
/* A Runge-Kutta step of order 4 of the state x from t to t + h. */
static int advance(double t, double h, double *x, const double *p)
{
    double k[4][NX], y[NX];
    if (!(t - t == 0 && h - h == 0)) return -1;
    rates(t, x, p, k[0]);
    for (int i = 0; i < NX; i++) y[i] = x[i] + 0.5 * h * k[0][i];
    rates(t + 0.5 * h, y, p, k[1]);
    for (int i = 0; i < NX; i++) y[i] = x[i] + 0.5 * h * k[1][i];
    rates(t + 0.5 * h, y, p, k[2]);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h * k[2][i];
    rates(t + h, y, p, k[3]);
    for (int i = 0; i < NX; i++) y[i] = x[i] + h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
    for (int i = 0; i < NX; i++) if (!(y[i] - y[i] == 0)) return -1;
    for (int i = 0; i < NX; i++) x[i] = y[i];
    return 0;
}
