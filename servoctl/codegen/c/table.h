#ifndef TABLE_H
#define TABLE_H

/* n knots in ascending order. The cells of equal length, as many, lead to the first row that they may hold, and to the
   last. */
typedef struct {
    int n;
    double start, cells_per_second;
    const double *at;
    const int *cells;
} Knots;

/* The number of knots that s has reached; 0 if it is NaN. */
static double row(const Knots *knots, double s)
{
    const double place = (s - knots->start) * knots->cells_per_second;
    const int cell = place > 0 ? (place < (double)knots->n ? (int)place : knots->n - 1) : 0;
    int low = knots->cells[2 * cell], high = knots->cells[2 * cell + 1];
    while (low < high) {
        const int middle = (low + high) / 2;
        if (knots->at[middle] <= s) low = middle + 1;
        else high = middle;
    }
    return (double)low;
}

static double entry(const double *column, int columns, double row) { return column[(int)row * columns]; }

#endif
