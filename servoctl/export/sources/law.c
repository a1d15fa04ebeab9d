
static void start(double *z)
{
    for (int i = 0; i < NZ; i++) z[i] = z0[i];
}

/* One sample: u and the next z, by the row of the table that is nearest to t. */
static int step(double t, const double *y, double *z, double *u)
{
    double x[NY + NZ + 1] = {0}, all[NO], row[WIDTH];
    double k = floor((t - T0) * RATE + 0.5);
    if (!(t - t == 0)) return -1;
    k = k > 0 ? k : 0;
    k = k < ROWS - 1 ? k : ROWS - 1;
    for (int i = 0; i < NY; i++) x[i] = y[i];
    for (int i = 0; i < NZ; i++) x[NY + i] = z[i];
    schedule((int)k, row);
    law(t, x, row, all);
    for (int i = 0; i < NU + NZ; i++) if (!(all[i] - all[i] == 0)) return -1;
    for (int i = 0; i < NU; i++) u[i] = all[i];
    for (int i = 0; i < NZ; i++) z[i] = all[NU + i];
    return 0;
}
