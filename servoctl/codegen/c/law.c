#include "unit.h"

/* The function of a law, whose address a loop takes. */
void FN(step)(double t, const double *x, const double *p, double *y) { NAME(t, x, p, y); }
