
/* The parameters, and the references behind them. */
static void join(const double *p, const double *ref, double *all)
{
    for (int i = 0; i < NP; i++) all[i] = p[i];
    for (int i = NP; i < NALL; i++) all[i] = ref[i - NP];
}
