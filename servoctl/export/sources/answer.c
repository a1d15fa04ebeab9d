
/* Jets z and u at them; -1, and no change, if a number is not finite. */
static int answer(double t, const double *jets, const double *p, double *z, double *u)
{
    double found[NU + 1];
    actuation(t, jets, p, found);
    for (int i = 0; i < NJ; i++) if (!(jets[i] - jets[i] == 0)) return -1;
    for (int i = 0; i < NU; i++) if (!(found[i] - found[i] == 0)) return -1;
    for (int i = 0; i < NJ; i++) z[i] = jets[i];
    for (int i = 0; i < NU; i++) u[i] = found[i];
    return 0;
}
