
/* Jets z = (x, highest derivative) and actuation u at state x of the plan. */
static int feedforward(double t, const double *x, const double *p, double *z, double *u)
{
    double dx[NX], jets[NJ];
    if (!(t - t == 0)) return -1;
    rates(t, x, p, dx);
    for (int i = 0; i < NX; i++) jets[i] = x[i];
    for (int i = 0; i < N; i++) jets[NX + i] = dx[NX - N + i];
    return answer(t, jets, p, z, u);
}
