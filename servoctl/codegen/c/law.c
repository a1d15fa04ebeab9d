#include "unit.h"

/* The function of a law under a name of its own: a loop takes its address. */
void FN(step)(double t, const double *x, const double *p, double *y) { NAME(t, x, p, y); }
