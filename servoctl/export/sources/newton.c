
/* Newton's method for the coordinates in x, whose rates and second derivatives follow; the number of corrections. */
static int feedforward(double t, double *x, const double *p, double *z, double *u)
{
    double y[NY], jets[NJ], before = HUGE_VAL;
    if (!(t - t == 0)) return -1;
    for (int iteration = 0; iteration <= ITERATIONS; iteration++) {
        double defect = 0;
        path(t, x, p, y);
        for (int i = 0; i < NQ; i++) {
            const double e = fabs(y[i]) / (1 + fabs(x[i]));
            if (!(e < HUGE_VAL)) return -1;
            if (e > defect) defect = e;
        }
        if (defect <= TOLERANCE || (defect <= STALLED && defect >= before / 2)) {
            for (int i = 0; i < NQ; i++) jets[i] = x[i];
            for (int i = 0; i < 2 * N; i++) jets[NQ + i] = y[FIRST + i];
            for (int i = 0; i < N; i++) x[NQ + i] = jets[NQ + i];
            return answer(t, jets, p, z, u) ? -1 : iteration;
        }
        for (int i = 0; i < NQ; i++) x[i] += y[i];
        before = defect;
    }
    return -1;
}
