/* The step of a limited law, called from outside. */
#include "unit.h"
#include "allocation.h"

void FN(step)(double t, const double *x, const double *row, double *y)
{
    limited_law(t, x, row, y);
}
